"""What this project measures of itself: measures beside those of `rstrack.bench`, and what they need."""
