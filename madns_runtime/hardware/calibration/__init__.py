"""
Calibration of sensors from what they gave in known circumstances: numpy alone, no device is driven here.

A reading is alignment (scale raw - bias). At rest a gyroscope's truth is zero: the mean is its bias. Gravity and the
Earth's field have one strength however a sensor lies: what it gives in many directions lies on an ellipsoid, whose
centre is the bias (hard iron) and whose axes are the scale; with enough directions also how axes leak into each other
(soft iron). Strength alone tells nothing of a rotation as a whole: how the sensor sits in the vehicle is measured otherwise.
"""
