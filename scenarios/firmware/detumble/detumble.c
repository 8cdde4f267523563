/*
 * A flight computer that stops a tumbling satellite: magnetometer in, coils and wheels out.
 *
 * It reads its magnetometer itself, over its bus; the vehicle tells it the gyro's rates and the time, in frames on
 * the serial line, and carries out what it commands. Whatever board.h's functions run on, this file is the same.
 */
#include "board.h"
#include "control.h"
#include "flight_frames.h"
#include "magnetometer.h"

static flight_parser parser;
static flight_sender sender;
static struct control control;
static double command_s = 0.5, lead_s = 0.5; /* a command is given as often, and begins so long after it was given */
static double next_s;
static bool is_set_up; /* before that it knows none of the vehicle's settings, and commands nothing */
static uint32_t deaf; /* times that the magnetometer did not answer */

static struct control_settings settings = {
    .hard_iron_t = {0.0f, 0.0f, 0.0f},
    .dipole_a_m2_max = 0.2f,
    .damping_n_m_s = 3e-4f,
    .hold_below_rad_s = 0.0105f, /* 0.6 deg/s */
    .hold_damping_n_m_s = 1e-3f,
    .hold_stiffness_n_m = 1e-4f,
    .torque_n_m_max = 1e-4f,
    .span_s = 1.0f,
    .settled_s = 3.0f,
};

static bool is_called(const flight_setting *setting, const char *name)
{
    for (size_t at = 0; at < sizeof setting->name; at++) {
        if (setting->name[at] != name[at])
            return false;
        if (!name[at])
            return true;
    }
    return false;
}

/* Take one of the scenario's settings; those that are not known here are somebody else's. */
static void take_setting(const flight_setting *setting)
{
    static const struct { const char *name; float *value; } numbers[] = {
        {"dipole_a_m2_max", &settings.dipole_a_m2_max},
        {"damping_n_m_s", &settings.damping_n_m_s},
        {"hold_below_rad_s", &settings.hold_below_rad_s},
        {"hold_damping_n_m_s", &settings.hold_damping_n_m_s},
        {"hold_stiffness_n_m", &settings.hold_stiffness_n_m},
        {"torque_n_m_max", &settings.torque_n_m_max},
        {"span_s", &settings.span_s},
        {"settled_s", &settings.settled_s},
    };
    if (is_called(setting, "hard_iron_t") && setting->index < 3)
        settings.hard_iron_t[setting->index] = (float)setting->value;
    else if (is_called(setting, "command_s"))
        command_s = setting->value;
    else if (is_called(setting, "lead_s"))
        lead_s = setting->value;
    for (size_t at = 0; at < sizeof numbers / sizeof numbers[0]; at++)
        if (is_called(setting, numbers[at].name))
            *numbers[at].value = (float)setting->value;
}

static void take_reading(void)
{
    const flight_reading *reading = FLIGHT_STRUCT(&parser, flight_reading);
    size_t count;
    const double *values = flight_values(&parser, &count);
    if (reading && reading->sensor == FLIGHT_SENSOR_GYRO && count == 3)
        control_take_rate(&control, reading->valid_s, values);
    else if (reading && reading->sensor == FLIGHT_SENSOR_MAGNETOMETER && count == 3)
        magnetometer_told(values);
}

static void answer_tick(void)
{
    double t_s = parser.frame.header.t_s, wanted[3];
    float field_t[3];
    flight_answers(&sender, &parser);
    if (magnetometer_read(field_t))
        control_take_field(&control, t_s, field_t);
    else
        deaf++;
    if (is_set_up && t_s >= next_s - 1e-6) {
        if (control_dipole(&control, wanted))
            flight_command_dipole(&sender, wanted, t_s + lead_s, command_s);
        else if (control_torque(&control, wanted))
            flight_command_torque(&sender, wanted, t_s + lead_s, command_s);
        next_s += command_s;
        if (next_s < t_s) /* ticks were lost */
            next_s = t_s + command_s;
    }
    if (control.across_rad_s >= 0.0f) {
        flight_say_estimate(&sender, "rate_across_rad_s", (double)control.across_rad_s);
        flight_say_estimate(&sender, "is_held", control.phase == HOLD ? 1.0 : 0.0);
        flight_say_estimate(&sender, "deaf", (double)deaf);
    }
    flight_say_done(&sender, clock_us());
}

static void take_frame(void)
{
    const flight_setting *setting;
    switch (parser.frame.header.type) {
    case FLIGHT_SETUP:
        next_s = parser.frame.header.t_s;
        is_set_up = true;
        control_start(&control, &settings);
        break;
    case FLIGHT_SETTING:
        if ((setting = FLIGHT_STRUCT(&parser, flight_setting)) != NULL)
            take_setting(setting);
        control.settings = settings;
        break;
    case FLIGHT_READING:
        take_reading();
        break;
    case FLIGHT_TICK:
        answer_tick();
        break;
    }
}

static void write_line(void *where, const uint8_t *bytes, size_t count)
{
    (void)where;
    uart_write(bytes, count);
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
            if (flight_put(&parser, bytes[at]))
                take_frame();
        if (!count)
            board_wait();
    }
}
