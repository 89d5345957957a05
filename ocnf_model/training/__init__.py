"""Training stage by stage (SEMANTICS 5): one level after another, coarse to fine, resumable at any moment."""
