"""The wire: what flows between the processes, in which bytes, over which sockets."""
