"""Models of your own scenes: `init` proposes one, `compare` measures it, the gate admits it."""
