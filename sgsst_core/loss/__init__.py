"""The SOS loss and its gradient, its float64 reference, and the rule that tells when it has stopped falling."""
