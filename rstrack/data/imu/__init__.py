"""What an inertial measurement unit recorded, and what is known of it."""
