/*
 * Holds a satellite's semi-major axis, as hold.c does: flight software in C99 that speaks frames (flight_frames.h).
 *
 * On standard input and output here; on a microcontroller the two functions below are its UART's.
 */
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <time.h>

#define FLIGHT_FRAME_BYTES_MAX 1024
#include "flight_frames.h"

#define MU_M3_S2 398600441500000.0 /* EGM-96 */

static void write_bytes(void *where, const uint8_t *bytes, size_t count)
{
    (void)where;
    fwrite(bytes, 1, count, stdout);
}

static uint64_t clock_us(void)
{
    return (uint64_t)(1e6 * (double)clock() / CLOCKS_PER_SEC) + 1;
}

static double a_wanted_m, tolerance_m = 50.0, lead_s = 3.0, next_s;

static void take_setting(const flight_setting *setting)
{
    if (strcmp(setting->name, "a_m") == 0)
        a_wanted_m = setting->value;
    if (strcmp(setting->name, "tolerance_m") == 0)
        tolerance_m = setting->value;
    if (strcmp(setting->name, "lead_s") == 0)
        lead_s = setting->value;
}

static void guide(flight_sender *sender, double t_s, const double *v)
{
    double distance_m = sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
    double speed_m_s = sqrt(v[3] * v[3] + v[4] * v[4] + v[5] * v[5]);
    double a_m = 1.0 / (2.0 / distance_m - speed_m_s * speed_m_s / MU_M3_S2);
    flight_say_estimate(sender, "a_m", a_m);
    flight_say_estimate(sender, "a_error_m", a_m - a_wanted_m);
    if (fabs(a_m - a_wanted_m) > tolerance_m && t_s >= next_s) {
        double delta_v_m_s[3] = {0.0, 0.0, 0.0};
        /* d(energy) = v dv = mu da / (2 a^2) */
        delta_v_m_s[1] = MU_M3_S2 * (a_wanted_m - a_m) / (2.0 * a_m * a_m * speed_m_s);
        flight_command_delta_v(sender, delta_v_m_s, t_s + lead_s, FLIGHT_FRAME_RTN);
        next_s = t_s + lead_s + 2.0; /* until the burn shows in what GNSS says */
    }
}

int main(void)
{
    static flight_parser parser;
    static flight_sender sender;
    double gnss[6] = {0};
    int byte, has_gnss = 0;
    flight_start(&parser, &sender, write_bytes, NULL);
    while ((byte = getchar()) != EOF) {
        if (!flight_put(&parser, (uint8_t)byte))
            continue;
        switch (parser.frame.header.type) {
        case FLIGHT_SETTING:
            take_setting(FLIGHT_STRUCT(&parser, flight_setting));
            break;
        case FLIGHT_READING:
            if (FLIGHT_STRUCT(&parser, flight_reading)->sensor == FLIGHT_SENSOR_GNSS) {
                size_t count;
                const double *values = flight_values(&parser, &count);
                has_gnss = count == 6;
                if (has_gnss)
                    memcpy(gnss, values, sizeof gnss);
            }
            break;
        case FLIGHT_TICK:
            flight_answers(&sender, &parser);
            if (has_gnss)
                guide(&sender, parser.frame.header.t_s, gnss);
            has_gnss = 0;
            flight_say_done(&sender, clock_us());
            fflush(stdout); /* the tick is waiting */
            break;
        default:
            break;
        }
    }
    fprintf(stderr, "%u frames, %u damaged, %u overlong, %u lost\n", (unsigned)parser.frames,
            (unsigned)parser.damaged, (unsigned)parser.overlong, (unsigned)parser.lost);
    return 0;
}
