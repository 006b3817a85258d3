// Injects faults into system calls that write. run.py preloads this library and configures it by environment variables:
//
//   FAULT_ROOT   folder below which files are affected, so that terminals, pipes and libraries' own files are left alone
//   FAULT_LOG    file that gets a line per such call: "-" (succeeded) or "!" (failed or partial), the call's group, its file
//   FAULT        "GROUP N KIND STICKY": calls of GROUP (write, truncate, fsync, open, mkdir, rename, link, remove or any) fail, the
//                first of them the N-th, from 1; if STICKY is 1, all later ones, too. KIND is ENOSPC, EIO or EINTR, the error; short:
//                half is written, and the call returns that count; torn: the same, and the next call fails with ENOSPC
//
// A rename is logged under the new name. Opening read-only is not a write. These are the functions by which the program writes (nm -D).

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/syscall.h>
#include <sys/types.h>
#include <unistd.h>

enum { PASS, FAIL, HALF };

static const char *root;
static char group_that_fails[16], kind[16];
static long first;
static int error, is_sticky, is_torn, log_file = -1;
static atomic_long seen;

__attribute__((constructor)) static void read_settings(void) {
    root = getenv("FAULT_ROOT");
    sscanf(getenv("FAULT") ?: "", "%15s %ld %15s %d", group_that_fails, &first, kind, &is_sticky);
    error = !strcmp(kind, "EIO") ? EIO : !strcmp(kind, "EINTR") ? EINTR : ENOSPC;
    is_torn = !strcmp(kind, "torn");
    const char *log = getenv("FAULT_LOG");
    if (log) log_file = syscall(SYS_openat, AT_FDCWD, log, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0644);
    unsetenv("LD_PRELOAD"); // child processes are not affected
}

// Writes to `path` the path of `name` in the folder that is open as `dir`; without a name, the path of the open file itself.
static void resolve(int dir, const char *name, char *path) {
    char link[32];
    ssize_t length = 0;
    if (!name || name[0] != '/') {
        snprintf(link, sizeof link, "/proc/self/fd/%d", dir);
        length = readlink(link, path, PATH_MAX - 1);
    }
    path[length < 0 ? 0 : length] = 0;
    if (name) snprintf(path + strlen(path), PATH_MAX, name[0] == '/' ? "%s" : "/%s", name);
}

// Decides the outcome of a call of `group` on a file, and logs it. `bytes` is the number of bytes it writes; only more than one
// can be halved.
static int decide(const char *group, int dir, const char *name, size_t bytes) {
    char path[2 * PATH_MAX], line[2 * PATH_MAX + 32];
    int before = errno, outcome = PASS;
    if (!root) return PASS;
    resolve(dir, name, path);
    size_t length = strlen(root);
    if (strncmp(path, root, length) || (path[length] && path[length] != '/')) return errno = before, PASS;
    if (first && (!strcmp(group_that_fails, "any") || !strcmp(group_that_fails, group))) {
        long later = ++seen - first; // number of calls since the first that fails
        if (is_torn && later > 0) outcome = later == 1 || is_sticky ? FAIL : PASS;
        else if (later == 0 || (later > 0 && is_sticky))
            outcome = !is_torn && strcmp(kind, "short") ? FAIL : bytes > 1 ? HALF : PASS;
    }
    int size = snprintf(line, sizeof line, "%c %s %s\n", outcome == PASS ? '-' : '!', group, path);
    if (log_file >= 0) syscall(SYS_write, log_file, line, size);
    errno = outcome == FAIL ? error : before;
    return outcome;
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
// Defines a wrapper of a call that succeeds or fails as a whole.
#define WHOLE(group, name, dir, file, parameters, arguments) \
    int name parameters { return decide(group, dir, file, 0) == FAIL ? -1 : REAL(name) arguments; }

WHOLE("truncate", ftruncate64, fd, NULL, (int fd, off64_t size), (fd, size))
WHOLE("fsync", fsync, fd, NULL, (int fd), (fd))
WHOLE("mkdir", mkdir, AT_FDCWD, path, (const char *path, mode_t mode), (path, mode))
WHOLE("rename", rename, AT_FDCWD, to, (const char *from, const char *to), (from, to))
WHOLE("link", linkat, b, to, (int a, const char *from, int b, const char *to, int flags), (a, from, b, to, flags))
WHOLE("link", symlink, AT_FDCWD, path, (const char *target, const char *path), (target, path))
WHOLE("remove", unlink, AT_FDCWD, path, (const char *path), (path))
WHOLE("remove", rmdir, AT_FDCWD, path, (const char *path), (path))
WHOLE("remove", unlinkat, dir, path, (int dir, const char *path, int flags), (dir, path, flags))

// Defines a wrapper of an open call. The mode is an argument only if the call may create a file; passing 0 otherwise is harmless
// on every ABI of Linux.
#define OPEN(name, dir, parameters, arguments)                                                   \
    int name parameters {                                                                        \
        va_list rest;                                                                            \
        va_start(rest, flags);                                                                   \
        mode_t mode = flags & (O_CREAT | __O_TMPFILE) ? va_arg(rest, mode_t) : 0;                \
        va_end(rest);                                                                            \
        int writes = (flags & O_ACCMODE) != O_RDONLY || flags & (O_CREAT | O_TRUNC);             \
        return writes && decide("open", dir, path, 0) == FAIL ? -1 : REAL(name) arguments;       \
    }

OPEN(open64, AT_FDCWD, (const char *path, int flags, ...), (path, flags, mode))
OPEN(openat64, dir, (int dir, const char *path, int flags, ...), (dir, path, flags, mode))

ssize_t write(int fd, const void *from, size_t n) {
    int outcome = decide("write", fd, NULL, n);
    return outcome == FAIL ? -1 : REAL(write)(fd, from, outcome == HALF ? n / 2 : n);
}
