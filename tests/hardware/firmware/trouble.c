/*
 * The detumbling flight computer, with a trouble that its settings ask for: from a time on it floods its line, or faults.
 *
 * flood_at_s, flood_s: it writes without a pause for so long, by its own clock, and reads nothing meanwhile;
 * flood_frames: whole frames instead of noise. fault_at_s: it jumps to where no program is. lockup_at_s: it does the same
 * with its vectors there, too: a fault within the fault, at which the emulator gives up.
 */
#define main detumble_main
#include "detumble.c"
#undef main

#define NEVER_S 1e12

static double flood_at_s = NEVER_S, flood_s = 1.0, flood_frames, fault_at_s = NEVER_S, lockup_at_s = NEVER_S;

#define NOWHERE 0x60000001u
#define VECTORS (*(volatile uint32_t *)0xE000ED08)

static void take_trouble(const flight_setting *setting)
{
    static const struct { const char *name; double *value; } numbers[] = {
        {"flood_at_s", &flood_at_s},
        {"flood_s", &flood_s},
        {"flood_frames", &flood_frames},
        {"fault_at_s", &fault_at_s},
        {"lockup_at_s", &lockup_at_s},
    };
    for (size_t at = 0; at < sizeof numbers / sizeof numbers[0]; at++)
        if (is_called(setting, numbers[at].name))
            *numbers[at].value = setting->value;
}

static void flood(void)
{
    static const uint8_t noise[] = "FLOODFLOODFLOODFLOODFLOODFLOODFLOODFLOODFLOODFLOODFLOODFLOODFLO";
    uint64_t end_us = clock_us() + (uint64_t)(flood_s * 1e6);
    flood_at_s = NEVER_S;
    while (clock_us() < end_us)
        if (flood_frames)
            flight_say_done(&sender, clock_us());
        else
            uart_write(noise, sizeof noise); /* with a zero at its end: the next is another frame */
}

static void make_trouble(void)
{
    const flight_setting *setting;
    double t_s = parser.frame.header.t_s;
    if (parser.frame.header.type == FLIGHT_SETTING) {
        if ((setting = FLIGHT_STRUCT(&parser, flight_setting)) != NULL)
            take_trouble(setting);
    } else if (parser.frame.header.type == FLIGHT_TICK) {
        if (t_s >= lockup_at_s)
            VECTORS = 0x60000000;
        if (t_s >= fault_at_s || t_s >= lockup_at_s)
            ((void (*)(void))(uintptr_t)NOWHERE)();
        if (t_s >= flood_at_s)
            flood();
    }
}

int main(void)
{
    board_start();
    control_start(&control, &settings);
    flight_start(&parser, &sender, write_line, NULL);
    magnetometer_start();
    flight_say_hello(&sender, clock_us());
    for (;;) {
        uint8_t bytes[64];
        size_t count = uart_read(bytes, sizeof bytes);
        for (size_t at = 0; at < count; at++)
            if (flight_put(&parser, bytes[at])) {
                take_frame();
                make_trouble();
            }
        if (!count)
            board_wait();
    }
}
