"""Direct alignment of images to keyframes along a spline (Kerl et al., ICCV 2015), to be read in this order.

- optimizer: the step, equation (12), coarse to fine; images are linearised anew only where their rows have moved
- observation: an image against a keyframe, its scale and its last linearisation; the score test of a frame
- linearise: kernels, sums and chain rule of one image: its part of the normal equations
- residuals: the kernels of the geometric error, equations (6) and (15), and the photometric error, (8) and (14)
- weights: Student-t weights, equation (11), σ of the residuals, how many pixels are independent
- block_sums: sums of pixels over blocks of rows, in integers
- normal_equations: from blocks to control points, elimination of nuisance unknowns, banded solve, Anderson mixing
- brightness, priors: what else is unknown of an image, what else is known of the motion
- spline_state: the spline while it grows and moves
- free_space: what of a frame moves by itself
"""
