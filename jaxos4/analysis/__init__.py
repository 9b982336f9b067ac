"""How good a fit is: information, bounds, covariances, residuals, predictions."""
