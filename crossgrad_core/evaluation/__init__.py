"""Drawing held-out views and measuring them."""
