"""The ground before any mark: elevation, photo and classes become pace."""
