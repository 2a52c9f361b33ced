"""Physics of a batch of simulations: the contract, and an engine in a file each."""
