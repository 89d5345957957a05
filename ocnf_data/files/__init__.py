"""Files: local or remote storage, YAML, validated records, locks."""
