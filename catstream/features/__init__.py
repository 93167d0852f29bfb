"""The features of a window of an image, and the score of a linear model of them."""

#: Logged at the first start after an installation, before the kernels are compiled.
COMPILING = "compiling kernels, once: about 8 s"
