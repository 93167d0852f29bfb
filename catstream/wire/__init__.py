"""The wire: the encoding of messages, and the sockets between the processes."""
