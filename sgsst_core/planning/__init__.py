"""What a scene does not need is left out: measured by a probe, decided before the first step."""
