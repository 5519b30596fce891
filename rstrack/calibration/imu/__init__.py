"""Where an IMU sits and what its clock, biases and scale are, from a track and the samples."""
