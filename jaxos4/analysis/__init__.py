"""What a fit is worth: information, bounds, covariances, residuals, predictions."""
