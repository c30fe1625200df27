"""What a person reads of several tests at once: tables, pages and pictures of `foamfit.study`."""
