"""Quality of inputs and results: findings, novel views, multi-view consistency, and comparison with exact gradients."""
