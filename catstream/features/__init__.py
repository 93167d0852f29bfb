"""The features of a window of an image, and the score of a linear model of them."""
