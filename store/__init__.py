"""Everything on disk: logs, archive, derivations, catalogue, query, export, fixity."""
