"""Networks that identify a flight: features, training, architecture, file."""
