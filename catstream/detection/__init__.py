"""Finds the object in a frame with the newest model."""

#: Logged at the first start after an installation, before the kernels are compiled.
COMPILING = "compiling kernels, once: about 8 s"
