"""A robot drives through furnished flats with a noisy detector: alarms of a `Home`, and rooms.

``python -m benchmarks.patrol --help`` lists the options.
"""
