"""What the page knows, and where it reads it: the control plane, servers, logs, live maps."""
