/*
 * What the program needs of a Stellaris LM3S6965: a clock, a serial line, an I2C bus.
 *
 * Registers are those of its data sheet (DS-LM3S6965, chapters 10, 12 and 14).
 */
#ifndef BOARD_H
#define BOARD_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define UART0_INTERRUPT 5

/* Microseconds since `board_start`, as this board's crystal counts them. Call it more often than once in 1.3 s. */
uint64_t clock_us(void);
void clock_interrupt(void);

/* The serial line: what has come is kept until it is read; what found no room is counted. */
void uart_interrupt(void);
size_t uart_read(uint8_t *bytes, size_t room);
void uart_write(const uint8_t *bytes, size_t count);
extern volatile uint32_t uart_lost_bytes;

/* One transfer on the bus; false if nobody answers. */
bool i2c_write(uint8_t address, const uint8_t *bytes, size_t count);
bool i2c_read(uint8_t address, uint8_t *bytes, size_t count);

void board_start(void);

/* Sleep until an interrupt, unless `uart_read` has something to give. */
void board_wait(void);

#endif
