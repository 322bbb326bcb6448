"""Reference posterior of scenes under any machine, by weighted draws of the context; slow."""
