"""Self-calibration: readouts, clocks and extrinsics out of an ordinary recording."""
