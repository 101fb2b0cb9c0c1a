"""Physics of a batch of scenes, the two motion primitives and what they achieved."""
