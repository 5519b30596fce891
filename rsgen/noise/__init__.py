"""What real sensors do to clean images: noise models of colour and depth cameras. Clean values stay in `truth/`."""
