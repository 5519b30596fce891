"""The whole spline adjusted at once: loops closed, a recording refined."""
