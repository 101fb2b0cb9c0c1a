"""Objects: rigid bodies of convex parts, kept in libraries. It needs neither MuJoCo nor JAX."""
