"""The paper's tables: from a folder of meshes to the paper's own layout, by a declarative file each."""
