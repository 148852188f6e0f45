"""The forward mapper: a forward sensor model fitted by expectation-maximisation."""
