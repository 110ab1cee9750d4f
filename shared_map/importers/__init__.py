"""Files to elevation, photo and classes on one square metric grid."""
