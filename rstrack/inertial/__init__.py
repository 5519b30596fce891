"""An IMU in the same spline: residuals, biases and gravity, prediction and bridging."""
