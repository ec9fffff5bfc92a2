"""What must agree before runs are compared: scenes, metrics, machines."""
