#include "board.h"

#define REGISTER(address) (*(volatile uint32_t *)(address))

/* System timer of the Cortex-M3: counts down 24 bits and begins anew. */
#define SYSTICK_CONTROL REGISTER(0xE000E010)
#define SYSTICK_RELOAD REGISTER(0xE000E014)
#define SYSTICK_VALUE REGISTER(0xE000E018)
#define SYSTICK_ON 0x7 /* enabled, with an interrupt, from the processor's clock */
#define SYSTICK_PERIOD 0x1000000
#define INTERRUPT_STATE REGISTER(0xE000ED04)
#define SYSTICK_PENDING (1u << 26)
#define CLOCKS_PER_US 12 /* by the data sheet of its oscillator, which is off by some percent */

#define INTERRUPTS_ON REGISTER(0xE000E100)

#define RUN_CLOCKS_1 REGISTER(0x400FE104) /* of UART and I2C */
#define RUN_CLOCKS_2 REGISTER(0x400FE108) /* of the ports */

#define UART_DATA REGISTER(0x4000C000)
#define UART_FLAGS REGISTER(0x4000C018)
#define UART_LINE REGISTER(0x4000C02C)
#define UART_CONTROL REGISTER(0x4000C030)
#define UART_MASK REGISTER(0x4000C038)
#define UART_CLEAR REGISTER(0x4000C044)
#define RX_EMPTY (1u << 4)
#define TX_FULL (1u << 5)
#define RX_INTERRUPTS 0x50 /* received, and received long ago */

#define I2C_ADDRESS REGISTER(0x40020000)
#define I2C_STATE REGISTER(0x40020004)
#define I2C_DATA REGISTER(0x40020008)
#define I2C_PERIOD REGISTER(0x4002000C)
#define I2C_CONTROL REGISTER(0x40020020)
#define I2C_RUN 1u
#define I2C_START 2u
#define I2C_STOP 4u
#define I2C_ACK 8u
#define I2C_BUSY 1u
#define I2C_ERROR 2u
#define I2C_POLLS_MAX 100000 /* a bus that hangs is no reason to hang */

#define RING_BYTES 4096 /* a power of two */

static volatile uint8_t ring[RING_BYTES];
static volatile uint32_t ring_in, ring_out;
volatile uint32_t uart_lost_bytes;
static volatile uint32_t turns;

void clock_interrupt(void)
{
    turns++;
}

uint64_t clock_us(void)
{
    uint32_t counted, pending, value;
    do { /* 0 stands between two turns, and does not tell of which it is */
        counted = turns;
        pending = INTERRUPT_STATE & SYSTICK_PENDING;
        value = SYSTICK_VALUE;
    } while (value == 0 || counted != turns || pending != (INTERRUPT_STATE & SYSTICK_PENDING));
    if (pending) /* it has begun anew, and the interrupt has yet to be taken */
        counted++;
    return ((uint64_t)counted * SYSTICK_PERIOD + (SYSTICK_PERIOD - value)) / CLOCKS_PER_US;
}

void uart_interrupt(void)
{
    UART_CLEAR = RX_INTERRUPTS;
    while (!(UART_FLAGS & RX_EMPTY)) {
        uint8_t byte = (uint8_t)UART_DATA;
        if (ring_in - ring_out < RING_BYTES)
            ring[ring_in++ % RING_BYTES] = byte;
        else
            uart_lost_bytes++;
    }
}

size_t uart_read(uint8_t *bytes, size_t room)
{
    size_t count = 0;
    while (count < room && ring_out != ring_in)
        bytes[count++] = ring[ring_out++ % RING_BYTES];
    return count;
}

void uart_write(const uint8_t *bytes, size_t count)
{
    while (count--) {
        while (UART_FLAGS & TX_FULL)
            ;
        UART_DATA = *bytes++;
    }
}

/* Wait until the bus's master is done; false if nobody answered. */
static bool i2c_done(void)
{
    for (uint32_t polls = 0; polls < I2C_POLLS_MAX; polls++)
        if (!(I2C_STATE & I2C_BUSY))
            return !(I2C_STATE & I2C_ERROR);
    return false;
}

bool i2c_write(uint8_t address, const uint8_t *bytes, size_t count)
{
    I2C_ADDRESS = (uint32_t)address << 1;
    for (size_t at = 0; at < count; at++) {
        I2C_DATA = bytes[at];
        I2C_STATE = I2C_RUN | (at == 0 ? I2C_START : 0) | (at + 1 == count ? I2C_STOP : 0);
        if (!i2c_done())
            return false;
    }
    return true;
}

bool i2c_read(uint8_t address, uint8_t *bytes, size_t count)
{
    I2C_ADDRESS = (uint32_t)address << 1 | 1u;
    for (size_t at = 0; at < count; at++) {
        I2C_STATE = I2C_RUN | (at == 0 ? I2C_START : 0) | (at + 1 == count ? I2C_STOP : I2C_ACK);
        if (!i2c_done())
            return false;
        bytes[at] = (uint8_t)I2C_DATA;
    }
    return true;
}

void board_start(void)
{
    SYSTICK_RELOAD = SYSTICK_PERIOD - 1;
    SYSTICK_VALUE = 0;
    SYSTICK_CONTROL = SYSTICK_ON;
    RUN_CLOCKS_1 = 1u << 12 | 1u; /* I2C 0, UART 0 */
    RUN_CLOCKS_2 = 0x3; /* ports A and B, where their lines end */
    UART_LINE = 0x70; /* eight bits, with queues */
    UART_CONTROL = 0x301; /* enabled, both ways */
    UART_MASK = RX_INTERRUPTS;
    INTERRUPTS_ON = 1u << UART0_INTERRUPT;
    I2C_CONTROL = 0x10; /* master */
    I2C_PERIOD = 5; /* 100 kHz at 12 MHz */
}

void board_wait(void)
{
    /* With interrupts held back nothing slips in between looking and sleeping; one that waits ends the sleep. */
    __asm volatile("cpsid i");
    if (ring_in == ring_out)
        __asm volatile("wfi");
    __asm volatile("cpsie i");
}
