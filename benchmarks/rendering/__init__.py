"""What is measured of the renderer, in processes of its own: see `benchmarks.rendering.worker`."""
