// Injects faults into system calls that write. run.py preloads this library and configures it by environment variables:
//
//   FAULT_ROOT    folder below which files are affected, so that terminals, pipes and libraries' own files are left alone
//   FAULT_LOG     file that gets a line per such call: "-" (succeeded) or "!" (failed or partial), the call's group, its file
//   FAULT_CALL    group of calls that fail: write truncate fsync open mkdir rename link remove, or any
//   FAULT_N       index of the first call of the group that fails, from 1; 0 lets all succeed
//   FAULT_KIND    ENOSPC, EIO, EINTR: the error; short: half is written, and the call returns that count; torn, torn-EIO: half is
//                 written as for short, and the next call fails with ENOSPC or EIO
//   FAULT_STICKY  1: all later calls fail, too (torn: the error persists); 2: later calls on the same file fail
//
// Files are logged under their names at the time of the call, a rename under the new name. Opening read-only is not a write.

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
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

enum { PASS, FAIL, HALF };

static const char *root, *call, *kind;
static long first;
static int error, sticky, logged = -1;
static atomic_long seen;
static char held[2 * PATH_MAX]; // file of the first call that failed

__attribute__((constructor)) static void begin(void) {
    root = getenv("FAULT_ROOT");
    call = getenv("FAULT_CALL") ?: "any";
    kind = getenv("FAULT_KIND") ?: "EIO";
    first = atol(getenv("FAULT_N") ?: "0");
    sticky = atoi(getenv("FAULT_STICKY") ?: "0");
    error = strstr(kind, "EIO") ? EIO : !strcmp(kind, "EINTR") ? EINTR : ENOSPC;
    const char *log = getenv("FAULT_LOG");
    if (log) logged = syscall(SYS_openat, AT_FDCWD, log, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0644);
    unsetenv("LD_PRELOAD"); // child processes are not affected
}

// Writes to `path` the path of `name` in the folder that is open as `dir`; without a name, the path of the open file itself.
static void resolve(int dir, const char *name, char *path) {
    char link[32];
    ssize_t length = 0;
    if (!name || (name[0] != '/' && dir != AT_FDCWD)) {
        snprintf(link, sizeof link, "/proc/self/fd/%d", dir);
        length = readlink(link, path, PATH_MAX - 1);
    } else if (name[0] != '/' && getcwd(path, PATH_MAX)) {
        length = strlen(path);
    }
    path[length < 0 ? 0 : length] = 0;
    if (name) snprintf(path + strlen(path), PATH_MAX - strlen(path), name[0] == '/' ? "%s" : "/%s", name);
}

// Decides the outcome of a call of `group` on a file, and logs it. `bytes` is the number of bytes it writes; only more than one
// can be halved.
static int decide(const char *group, int dir, const char *name, size_t bytes) {
    char path[2 * PATH_MAX], line[2 * PATH_MAX + 32];
    int before = errno;
    if (!root) return PASS;
    resolve(dir, name, path);
    size_t length = strlen(root);
    if (strncmp(path, root, length) || (path[length] && path[length] != '/')) return errno = before, PASS;
    int tears = !strncmp(kind, "torn", 4), cuts = tears || !strcmp(kind, "short"), what = PASS;
    if (!strcmp(call, "any") || !strcmp(call, group)) {
        long n = ++seen;
        if (tears && n > first) what = n == first + 1 || sticky ? FAIL : PASS;
        else if (n == first || (n > first && (sticky == 1 || (sticky == 2 && !strcmp(path, held)))))
            what = !cuts ? FAIL : bytes > 1 ? HALF : PASS;
        if (n == first) strcpy(held, path);
        if (first == 0) what = PASS;
    }
    int size = snprintf(line, sizeof line, "%c %s %s\n", what == PASS ? '-' : '!', group, path);
    if (logged >= 0) syscall(SYS_write, logged, line, size);
    errno = what == FAIL ? error : before;
    return what;
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
#define EXPORT __attribute__((visibility("default")))
// Defines a wrapper of a call that succeeds or fails as a whole.
#define WHOLE(group, name, dir, file, parameters, arguments)                                                          \
    EXPORT int name parameters { return decide(group, dir, file, 0) == FAIL ? -1 : REAL(name) arguments; }

WHOLE("truncate", ftruncate, fd, NULL, (int fd, off_t size), (fd, size))
WHOLE("truncate", ftruncate64, fd, NULL, (int fd, off64_t size), (fd, size))
WHOLE("truncate", fallocate, fd, NULL, (int fd, int mode, off_t from, off_t size), (fd, mode, from, size))
WHOLE("fsync", fsync, fd, NULL, (int fd), (fd))
WHOLE("fsync", fdatasync, fd, NULL, (int fd), (fd))
WHOLE("mkdir", mkdir, AT_FDCWD, path, (const char *path, mode_t mode), (path, mode))
WHOLE("mkdir", mkdirat, dir, path, (int dir, const char *path, mode_t mode), (dir, path, mode))
WHOLE("rename", rename, AT_FDCWD, to, (const char *from, const char *to), (from, to))
WHOLE("rename", renameat, b, to, (int a, const char *from, int b, const char *to), (a, from, b, to))
WHOLE("rename", renameat2, b, to, (int a, const char *from, int b, const char *to, unsigned f), (a, from, b, to, f))
WHOLE("link", link, AT_FDCWD, to, (const char *from, const char *to), (from, to))
WHOLE("link", linkat, b, to, (int a, const char *from, int b, const char *to, int f), (a, from, b, to, f))
WHOLE("link", symlink, AT_FDCWD, to, (const char *from, const char *to), (from, to))
WHOLE("remove", unlink, AT_FDCWD, path, (const char *path), (path))
WHOLE("remove", rmdir, AT_FDCWD, path, (const char *path), (path))
WHOLE("remove", unlinkat, dir, path, (int dir, const char *path, int flags), (dir, path, flags))
WHOLE("open", creat, AT_FDCWD, path, (const char *path, mode_t mode), (path, mode))
WHOLE("open", creat64, AT_FDCWD, path, (const char *path, mode_t mode), (path, mode))

// Defines a wrapper of an open call. The mode is an argument only if the call may create a file; passing 0 otherwise is harmless
// on every ABI of Linux.
#define OPEN(name, dir, parameters, arguments)                                                                        \
    EXPORT int name parameters {                                                                                      \
        va_list rest;                                                                                                 \
        va_start(rest, flags);                                                                                        \
        mode_t mode = flags & (O_CREAT | __O_TMPFILE) ? va_arg(rest, mode_t) : 0;                                     \
        va_end(rest);                                                                                                 \
        int writes = (flags & O_ACCMODE) != O_RDONLY || flags & (O_CREAT | O_TRUNC);                                  \
        return writes && decide("open", dir, path, 0) == FAIL ? -1 : REAL(name) arguments;                            \
    }

OPEN(open, AT_FDCWD, (const char *path, int flags, ...), (path, flags, mode))
OPEN(open64, AT_FDCWD, (const char *path, int flags, ...), (path, flags, mode))
OPEN(openat, dir, (int dir, const char *path, int flags, ...), (dir, path, flags, mode))
OPEN(openat64, dir, (int dir, const char *path, int flags, ...), (dir, path, flags, mode))

// Defines a wrapper of a call that may also be done partially.
#define PARTLY(name, fd, parameters, bytes, arguments, half)                                                          \
    EXPORT ssize_t name parameters {                                                                                  \
        int what = decide("write", fd, NULL, bytes);                                                                  \
        return what == FAIL ? -1 : what == HALF ? REAL(name) half : REAL(name) arguments;                             \
    }

PARTLY(write, fd, (int fd, const void *from, size_t n), n, (fd, from, n), (fd, from, n / 2))
PARTLY(pwrite, fd, (int fd, const void *from, size_t n, off_t at), n, (fd, from, n, at), (fd, from, n / 2, at))
PARTLY(pwrite64, fd, (int fd, const void *from, size_t n, off64_t at), n, (fd, from, n, at), (fd, from, n / 2, at))
PARTLY(sendfile, to, (int to, int from, off_t *at, size_t n), n, (to, from, at, n), (to, from, at, n / 2))
PARTLY(sendfile64, to, (int to, int from, off64_t *at, size_t n), n, (to, from, at, n), (to, from, at, n / 2))
PARTLY(copy_file_range, to, (int from, off64_t *a, int to, off64_t *b, size_t n, unsigned flags), n,
       (from, a, to, b, n, flags), (from, a, to, b, n / 2, flags))
// A partial write of several pieces writes the first of them; of a single piece, all but its last byte.
PARTLY(writev, fd, (int fd, const struct iovec *from, int n), n > 1 ? 2 : from->iov_len, (fd, from, n),
       (fd, n > 1 ? from : &(struct iovec){from->iov_base, from->iov_len - 1}, 1))
