"""The gradients of K views: Gramians, weighted sums and the passes that compute them."""
