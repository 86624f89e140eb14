"""Recording while a run goes on."""
