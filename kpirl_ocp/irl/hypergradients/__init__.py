"""The derivative of the IRL loss, in exchangeable ways, each with a certificate."""
