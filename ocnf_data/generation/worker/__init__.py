"""The child process that makes samples and can be killed, and the one that supervises it."""
