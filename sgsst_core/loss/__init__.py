"""SOS loss and its gradient, the float64 reference, and the test for convergence."""
