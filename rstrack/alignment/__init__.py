"""Dense alignment: residuals, sums over blocks, weights, normal equations, optimiser."""
