/*
 * From tumbling to rest: magnetic coils against the field's change (B-dot), then reaction wheels hold.
 *
 * Coils give no torque along the field, so B-dot stops the turning across it alone; what is left, and what disturbs
 * later, is for the wheels, which need a gyro. Pure: no clock, no registers.
 * Source: Stickler and Alfriend, Elementary Magnetic Attitude Control System, 1976.
 */
#ifndef CONTROL_H
#define CONTROL_H

#include <stdbool.h>

#define CONTROL_HISTORY 128

enum control_phase { DETUMBLE, HOLD };

struct control_settings {
    float hard_iron_t[3];     /* of the magnetometer: taken off what it reads */
    float dipole_a_m2_max;    /* of the coils, about each axis */
    float damping_n_m_s;      /* torque over the rate that it is against */
    float hold_below_rad_s;   /* rate across the field below which the wheels take over */
    float hold_damping_n_m_s; /* of the wheels: torque over rate */
    float hold_stiffness_n_m; /* of the wheels: torque over angle */
    float torque_n_m_max;     /* of the wheels, about each axis */
    float span_s;             /* over which the field's change is taken */
    float settled_s;          /* for which the rate stays low before the wheels take over */
};

struct control {
    struct control_settings settings;
    enum control_phase phase;
    double times_s[CONTROL_HISTORY]; /* of the newest fields, as a ring */
    float fields_t[CONTROL_HISTORY][3];
    unsigned newest, count;
    double low_since_s, rated_s;
    bool is_low, has_rate;
    float rate_rad_s[3], angle_rad[3]; /* by the gyro; the angle since the wheels took over */
    float change_t_s[3];               /* of the field */
    float across_rad_s;                /* rate across the field, as it changes; negative while unknown */
};

void control_start(struct control *control, const struct control_settings *settings);
void control_take_rate(struct control *control, double t_s, const double rate_rad_s[3]);
void control_take_field(struct control *control, double t_s, const float read_t[3]);

/* The dipole that brakes; false if there is none to give. */
bool control_dipole(const struct control *control, double dipole_a_m2[3]);

/* The torque that holds; false if there is none to give. */
bool control_torque(const struct control *control, double torque_n_m[3]);

#endif
