"""What a policy does on throws that no training has seen; what a skin can know."""
