#include "control.h"

#define FIELD_T_MIN 1e-6f /* weaker is none that turns anything */

static float length(const float v[3])
{
    /* Newton's iteration for the square root, from above: there is no library. */
    float square = v[0] * v[0] + v[1] * v[1] + v[2] * v[2];
    float root = square > 1.0f ? square : 1.0f;
    if (square <= 0.0f)
        return 0.0f;
    for (int step = 0; step < 64; step++) {
        float next = 0.5f * (root + square / root);
        if (next >= root)
            break;
        root = next;
    }
    return root;
}

static float limited(float value, float most)
{
    return value > most ? most : value < -most ? -most : value;
}

void control_start(struct control *control, const struct control_settings *settings)
{
    control->settings = *settings;
    control->phase = DETUMBLE;
    control->newest = control->count = 0;
    control->is_low = control->has_rate = false;
    control->across_rad_s = -1.0f;
    for (int axis = 0; axis < 3; axis++)
        control->rate_rad_s[axis] = control->angle_rad[axis] = control->change_t_s[axis] = 0.0f;
}

void control_take_rate(struct control *control, double t_s, const double rate_rad_s[3])
{
    float passed_s = control->has_rate ? (float)(t_s - control->rated_s) : 0.0f;
    for (int axis = 0; axis < 3; axis++) {
        control->rate_rad_s[axis] = (float)rate_rad_s[axis];
        if (control->phase == HOLD)
            control->angle_rad[axis] += control->rate_rad_s[axis] * passed_s;
    }
    control->rated_s = t_s;
    control->has_rate = true;
}

/* The oldest field that is no older than the span; the newest one if there is no other. */
static unsigned oldest_of_span(const struct control *control, double t_s)
{
    unsigned found = control->newest;
    for (unsigned back = 1; back < control->count; back++) {
        unsigned at = (control->newest + CONTROL_HISTORY - back) % CONTROL_HISTORY;
        if (t_s - control->times_s[at] > (double)control->settings.span_s + 1e-6)
            break;
        found = at;
    }
    return found;
}

void control_take_field(struct control *control, double t_s, const float read_t[3])
{
    control->newest = (control->newest + 1) % CONTROL_HISTORY;
    if (control->count < CONTROL_HISTORY)
        control->count++;
    float *field_t = control->fields_t[control->newest];
    for (int axis = 0; axis < 3; axis++)
        field_t[axis] = read_t[axis] - control->settings.hard_iron_t[axis];
    control->times_s[control->newest] = t_s;
    unsigned oldest = oldest_of_span(control, t_s);
    float passed_s = (float)(t_s - control->times_s[oldest]), strength_t = length(field_t);
    if (passed_s <= 0.0f || strength_t < FIELD_T_MIN)
        return;
    for (int axis = 0; axis < 3; axis++)
        control->change_t_s[axis] = (field_t[axis] - control->fields_t[oldest][axis]) / passed_s;
    control->across_rad_s = length(control->change_t_s) / strength_t;
    bool is_low = control->across_rad_s < control->settings.hold_below_rad_s;
    if (is_low && !control->is_low)
        control->low_since_s = t_s;
    control->is_low = is_low;
    bool is_settled = is_low && t_s - control->low_since_s >= (double)control->settings.settled_s;
    if (control->phase == DETUMBLE && is_settled && control->has_rate)
        control->phase = HOLD;
}

bool control_dipole(const struct control *control, double dipole_a_m2[3])
{
    const float *field_t = control->fields_t[control->newest];
    float strength_t = length(field_t);
    if (control->phase != DETUMBLE || control->across_rad_s < 0.0f || strength_t < FIELD_T_MIN)
        return false;
    float gain = -control->settings.damping_n_m_s / (strength_t * strength_t);
    for (int axis = 0; axis < 3; axis++) {
        float wanted = gain * control->change_t_s[axis];
        dipole_a_m2[axis] = (double)limited(wanted, control->settings.dipole_a_m2_max);
    }
    return true;
}

bool control_torque(const struct control *control, double torque_n_m[3])
{
    if (control->phase != HOLD)
        return false;
    for (int axis = 0; axis < 3; axis++) {
        float wanted = -control->settings.hold_damping_n_m_s * control->rate_rad_s[axis] -
                       control->settings.hold_stiffness_n_m * control->angle_rad[axis];
        torque_n_m[axis] = (double)limited(wanted, control->settings.torque_n_m_max);
    }
    return true;
}
