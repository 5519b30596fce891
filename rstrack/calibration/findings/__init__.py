"""What is said of a calibration: values and errors, residuals, pace, records."""
