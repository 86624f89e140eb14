"""Feature vectors and the 2-way normalized cut (eq. 1-3)."""
