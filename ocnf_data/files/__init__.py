"""Files: local or remote storage, YAML, validated records, locks; and how much memory there is."""
