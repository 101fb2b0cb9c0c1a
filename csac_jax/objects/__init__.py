"""Rigid bodies of convex parts, in libraries. None needs JAX; `descriptions` needs MuJoCo."""
