"""What is found out about a recording before it is tracked: colour's clock, and how colour darkens to the corners."""
