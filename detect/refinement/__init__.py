"""From a guess and the log's rays to the primitive, its covariance and the posterior probabilities of its kinds."""
