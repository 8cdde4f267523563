#include "magnetometer.h"

#include <stdint.h>

#include "board.h"

/* Registers and scales: data sheet of the LSM303DLHC, tables 18, 71, 72 and 75. */
#define ADDRESS 0x1E
#define CRA_REG_M 0x00
#define OUT_X_H_M 0x03
#define RATE_75_HZ 0x18
#define GAIN_1_3_GAUSS 0x20
#define CONTINUOUS 0x00
#define LSB_PER_GAUSS_XY 1100.0f
#define LSB_PER_GAUSS_Z 980.0f
#define T_PER_GAUSS 1e-4f

bool magnetometer_start(void)
{
    static const uint8_t settings[][2] = {
        {CRA_REG_M, RATE_75_HZ}, {CRA_REG_M + 1, GAIN_1_3_GAUSS}, {CRA_REG_M + 2, CONTINUOUS}};
    for (unsigned at = 0; at < sizeof settings / sizeof settings[0]; at++)
        if (!i2c_write(ADDRESS, settings[at], 2))
            return false;
    return true;
}

bool magnetometer_read(float field_t[3])
{
    static const uint8_t first = OUT_X_H_M;
    uint8_t bytes[6]; /* x, z, y, each with its high byte first */
    if (!i2c_write(ADDRESS, &first, 1) || !i2c_read(ADDRESS, bytes, sizeof bytes))
        return false;
    int16_t x = (int16_t)(bytes[0] << 8 | bytes[1]);
    int16_t z = (int16_t)(bytes[2] << 8 | bytes[3]);
    int16_t y = (int16_t)(bytes[4] << 8 | bytes[5]);
    field_t[0] = (float)x * (T_PER_GAUSS / LSB_PER_GAUSS_XY);
    field_t[1] = (float)y * (T_PER_GAUSS / LSB_PER_GAUSS_XY);
    field_t[2] = (float)z * (T_PER_GAUSS / LSB_PER_GAUSS_Z);
    return true;
}

void magnetometer_told(const double field_t[3])
{
    (void)field_t;
}
