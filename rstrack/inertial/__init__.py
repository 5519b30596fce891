"""An inertial measurement unit in the same spline: residuals, biases and gravity, prediction and bridging."""
