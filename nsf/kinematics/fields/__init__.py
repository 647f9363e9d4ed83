"""The fields of the reduced model, a module each (paper section 4)."""
