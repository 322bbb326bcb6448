"""Slow reference for the posterior of scenes under any machine, by weighted draws of h1."""
