"""Labels of a frame that a person corrects."""
