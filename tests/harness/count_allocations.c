/*
 * Counts a process's allocations: built as a shared object, preloaded, with PYTHONMALLOC=malloc for all of Python's.
 *
 * COUNT_ALLOCATIONS names a folder; each process, forked ones too, keeps its count in a file there that is named by its
 * pid: one number of 64 bits, there at any moment and after any end.
 */
#define _GNU_SOURCE
#include <fcntl.h>
#include <pthread.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <unistd.h>

extern void *__libc_malloc(size_t size);
extern void *__libc_calloc(size_t count, size_t size);

static _Atomic unsigned long long nobodys;
static _Atomic unsigned long long *counter = &nobodys;

static void open_file(void)
{
    const char *folder = getenv("COUNT_ALLOCATIONS");
    char path[4096];
    if (folder == NULL)
        return;
    snprintf(path, sizeof path, "%s/%d", folder, (int)getpid());
    int fd = open(path, O_RDWR | O_CREAT | O_CLOEXEC, 0600);
    if (fd < 0)
        return;
    if (ftruncate(fd, sizeof *counter) == 0) {
        void *page = mmap(NULL, sizeof *counter, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
        if (page != MAP_FAILED)
            counter = page;
    }
    close(fd);
}

__attribute__((constructor)) static void begin(void)
{
    open_file();
    pthread_atfork(NULL, NULL, open_file);
}

void *malloc(size_t size)
{
    atomic_fetch_add_explicit(counter, 1, memory_order_relaxed);
    return __libc_malloc(size);
}

void *calloc(size_t count, size_t size)
{
    atomic_fetch_add_explicit(counter, 1, memory_order_relaxed);
    return __libc_calloc(count, size);
}
