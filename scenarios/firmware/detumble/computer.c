/* The same program on a computer, as one that a vehicle starts: standard input and output for the serial line. */
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

#include "board.h"
#include "magnetometer.h"

volatile uint32_t uart_lost_bytes;
static float told_t[3];
static bool is_told;

void board_start(void)
{
}

void board_wait(void)
{
}

uint64_t clock_us(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000u + (uint64_t)now.tv_nsec / 1000u;
}

size_t uart_read(uint8_t *bytes, size_t room)
{
    ssize_t count = read(STDIN_FILENO, bytes, room);
    if (count <= 0)
        exit(0);
    return (size_t)count;
}

void uart_write(const uint8_t *bytes, size_t count)
{
    while (count > 0) {
        ssize_t written = write(STDOUT_FILENO, bytes, count);
        if (written <= 0)
            exit(1);
        bytes += written;
        count -= (size_t)written;
    }
}

bool magnetometer_start(void)
{
    return true;
}

void magnetometer_told(const double field_t[3])
{
    for (int axis = 0; axis < 3; axis++)
        told_t[axis] = (float)field_t[axis];
    is_told = true;
}

bool magnetometer_read(float field_t[3])
{
    for (int axis = 0; axis < 3; axis++)
        field_t[axis] = told_t[axis];
    bool was_told = is_told;
    is_told = false;
    return was_told;
}
