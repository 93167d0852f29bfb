"""Linear algebra without a theme of its own: types of arrays, ridge regression, Kalman filter, threads."""
