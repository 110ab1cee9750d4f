"""What enters and leaves a service, written down and fed to it again."""
