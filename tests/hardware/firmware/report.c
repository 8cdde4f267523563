/* Answers every byte with one line: whether the magnetometer answers, its field in nT, the clock in us. */
#include "board.h"
#include "magnetometer.h"

static void print(int64_t value)
{
    uint8_t digits[24];
    size_t at = sizeof digits;
    uint64_t rest = (uint64_t)(value < 0 ? -value : value);
    do {
        digits[--at] = (uint8_t)('0' + rest % 10);
        rest /= 10;
    } while (rest);
    if (value < 0)
        digits[--at] = '-';
    uart_write(digits + at, sizeof digits - at);
}

int main(void)
{
    board_start();
    bool is_there = magnetometer_start();
    for (;;) {
        uint8_t byte;
        float field_t[3] = {0};
        if (!uart_read(&byte, 1)) {
            board_wait();
            continue;
        }
        if (byte == 'F') /* flood */
            for (int line = 0; line < 20000; line++)
                uart_write((const uint8_t *)"FLOODFLOODFLOOD\n", 16);
        print(is_there && magnetometer_read(field_t));
        for (int axis = 0; axis < 3; axis++) {
            uart_write((const uint8_t *)" ", 1);
            print((int64_t)(field_t[axis] * 1e9f + (field_t[axis] < 0 ? -0.5f : 0.5f)));
        }
        uart_write((const uint8_t *)" ", 1);
        print((int64_t)clock_us());
        uart_write((const uint8_t *)"\n", 1);
    }
}
