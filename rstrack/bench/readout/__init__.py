"""The readout sweep: what each tracker's error comes to as the shutter gets slower."""
