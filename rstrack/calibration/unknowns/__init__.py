"""What is unknown, and what is known of it beforehand."""
