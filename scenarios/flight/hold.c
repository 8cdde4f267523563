/*
 * Holds a satellite's semi-major axis: flight software in C99 that speaks JSON lines.
 *
 * Reads the setup line, then one line a tick; answers each tick with one line. flight.settings:
 * a_m, the semi-major axis to hold, m; tolerance_m; lead_s, from command to burn.
 * Lines come without blanks between keys and values, so that finding a key needs no JSON library.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define MU_M3_S2 398600441500000.0 /* EGM-96 */
#define LINE_BYTES 1048576 /* more than a vehicle ever sends */

/* Return the text behind a key, or NULL. */
static const char *find(const char *text, const char *key)
{
    const char *at = text ? strstr(text, key) : NULL;
    return at ? at + strlen(key) : NULL;
}

static double number(const char *text, const char *key, double otherwise)
{
    const char *at = find(text, key);
    return at ? atof(at) : otherwise;
}

int main(void)
{
    static char line[LINE_BYTES];
    double a_wanted_m, tolerance_m, lead_s, next_s = 0.0;
    if (!fgets(line, sizeof line, stdin) || strncmp(line, "{\"setup\":", 9) != 0) {
        fprintf(stderr, "hold: expected a setup line\n");
        return 2;
    }
    a_wanted_m = number(line, "\"a_m\":", 0.0);
    tolerance_m = number(line, "\"tolerance_m\":", 50.0);
    lead_s = number(line, "\"lead_s\":", 3.0);
    if (a_wanted_m <= 0.0) {
        fprintf(stderr, "hold: expected flight.settings.a_m above 0\n");
        return 2;
    }
    while (fgets(line, sizeof line, stdin)) {
        const char *gnss = find(line, "\"gnss\":");
        const char *values = find(gnss, "\"values\":[");
        double t_s = number(line, "\"t_s\":", 0.0);
        double r[3], v[3];
        if (values && sscanf(values, "%lf,%lf,%lf,%lf,%lf,%lf", &r[0], &r[1], &r[2], &v[0], &v[1],
                             &v[2]) == 6) {
            double distance_m = sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2]);
            double speed_m_s = sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
            double a_m = 1.0 / (2.0 / distance_m - speed_m_s * speed_m_s / MU_M3_S2);
            printf("{\"estimate\":{\"a_m\":%.3f,\"a_error_m\":%.3f}", a_m, a_m - a_wanted_m);
            if (fabs(a_m - a_wanted_m) > tolerance_m && t_s >= next_s) {
                /* d(energy) = v dv = mu da / (2 a^2) */
                double dv_m_s = MU_M3_S2 * (a_wanted_m - a_m) / (2.0 * a_m * a_m * speed_m_s);
                printf(",\"commands\":[{\"delta_v_m_s\":[0,%.6f,0],\"at_s\":%.6f}]", dv_m_s,
                       t_s + lead_s);
                next_s = t_s + lead_s + 2.0; /* until the burn shows in what GNSS says */
            }
            printf("}\n");
        } else {
            printf("{}\n");
        }
        fflush(stdout); /* the tick is waiting */
    }
    return 0;
}
