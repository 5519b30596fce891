"""What is compared: pairs of images with their own lines, and windows of them."""
