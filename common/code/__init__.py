"""Which code runs: caches of compiled code, and libraries without the settings of others."""
