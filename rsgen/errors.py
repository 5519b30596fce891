"""The one exception that means "the input is wrong": its message is one line that says what, where and how to mend."""


class UserError(Exception):
    """Bad input (file, config, machine set-up). Command line tools print it as one line and exit with status 2."""
