"""Sensor models that turn clean images into what a camera reports, and the IMU."""
