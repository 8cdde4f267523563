/* From reset to main: the vector table, memory as C expects it, and the three functions that a compiler calls by itself. */
#include <stddef.h>
#include <stdint.h>

#include "board.h"

extern uint32_t text_end[], data_start[], data_end[], bss_start[], bss_end[], stack_top[];
extern int main(void);

void *memcpy(void *to, const void *from, size_t count)
{
    uint8_t *target = to;
    const uint8_t *source = from;
    while (count--)
        *target++ = *source++;
    return to;
}

void *memset(void *to, int value, size_t count)
{
    uint8_t *target = to;
    while (count--)
        *target++ = (uint8_t)value;
    return to;
}

void *memmove(void *to, const void *from, size_t count)
{
    uint8_t *target = to;
    const uint8_t *source = from;
    if (target < source)
        return memcpy(to, from, count);
    while (count--)
        target[count] = source[count];
    return to;
}

static void reset(void)
{
    memcpy(data_start, text_end, (size_t)((uint8_t *)data_end - (uint8_t *)data_start));
    memset(bss_start, 0, (size_t)((uint8_t *)bss_end - (uint8_t *)bss_start));
    main();
    for (;;)
        ;
}

/* A fault stops the program: whoever waits for its answers finds out. */
static void fault(void)
{
    for (;;)
        ;
}

__attribute__((section(".vectors"), used)) static void (*const vectors[16 + 8])(void) = {
    [0] = (void (*)(void))stack_top,
    [1] = reset,
    [2] = fault,
    [3] = fault,
    [4] = fault,
    [5] = fault,
    [6] = fault,
    [15] = clock_interrupt,
    [16 + UART0_INTERRUPT] = uart_interrupt,
};
