"""Several processes at one address, which serve one state of the models between them.

The supervisor (`supervisor`, `agreement`) binds the address, keeps the workers running and decides
what they serve; it never loads a model. A worker (`worker`, `peer`) is the service as it is, with a
channel (`wire`) to the supervisor.
"""
