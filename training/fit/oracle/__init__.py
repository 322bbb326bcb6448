"""Slow reference implementation of the posterior of scenes, for tests of the service.

The posterior is estimated by weighted draws of the hidden units h1. It supports every machine.
"""
