/* The magnetometer: an LSM303DLHC on the board's I2C bus; on a computer the readings that the vehicle tells. */
#ifndef MAGNETOMETER_H
#define MAGNETOMETER_H

#include <stdbool.h>

bool magnetometer_start(void);

/* Read the field along its axes x, y, z, in T; false if it does not answer. */
bool magnetometer_read(float field_t[3]);

/* Take a reading that the vehicle tells; a magnetometer of one's own has no use for it. */
void magnetometer_told(const double field_t[3]);

#endif
