"""What makes real readings of true distances: noise, rate, latency, drop-out."""
