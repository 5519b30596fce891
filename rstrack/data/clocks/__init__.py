"""When images were taken: clocks behind stamps that are times of arrival."""
