// Functions and data that code compiled with newer headers refers to and glibc 2.28 lacks. scripts/link_for_glibc.sh links this file.
#define HIDDEN __attribute__((visibility("hidden")))

// libstdc++ counts references without atomic instructions if this is true.
HIDDEN char __libc_single_threaded = 0;

// Since glibc 2.33 these are functions of their own, with and without 64. The first argument of the older ones is _STAT_VER.
#ifdef __x86_64__
#define STAT_VERSION 1
#else
#define STAT_VERSION 0
#endif
#define STAT(name, old, parameters, arguments...)                                     \
    int old(int, parameters);                                                         \
    HIDDEN int name(parameters) { return old(STAT_VERSION, arguments); }              \
    HIDDEN int name##64(parameters) __attribute__((alias(#name)));
#define AND ,
STAT(stat, __xstat, const char* path AND void* to, path, to)
STAT(lstat, __lxstat, const char* path AND void* to, path, to)
STAT(fstat, __fxstat, int file AND void* to, file, to)
STAT(fstatat, __fxstatat, int folder AND const char* path AND void* to AND int flags, folder, path, to, flags)

#ifdef PROGRAM
// Before glibc 2.34, a program had to run its own initializers. Its start code of 2.34 passes none.
typedef void Init(int, char**, char**);
extern Init* __init_array_start[] HIDDEN;
extern Init* __init_array_end[] HIDDEN;
void _init(void);
static void init(int argc, char** argv, char** env) {
    _init();
    for (Init** f = __init_array_start; f != __init_array_end; f++) (*f)(argc, argv, env);
}
typedef int Main(int, char**, char**);
int __real___libc_start_main(Main*, int, char**, Init*, void (*)(void), void (*)(void), void*);
HIDDEN int __wrap___libc_start_main(Main* main, int argc, char** argv, Init* none, void (*fini)(void), void (*rtld_fini)(void), void* end) {
    return __real___libc_start_main(main, argc, argv, none ? none : init, fini, rtld_fini, end);
}
#endif
