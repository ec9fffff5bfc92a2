"""Parts that the contract checks of several slots share."""
