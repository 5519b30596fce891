"""What is compared: pairs of images with their own lines, and stretches of them."""
