"""What a tracked frame is worth: whether it is found at all, and how well it is known."""
