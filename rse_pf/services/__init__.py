"""Services: typed requests to typed replies."""
