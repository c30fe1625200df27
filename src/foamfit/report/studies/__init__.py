"""Output for several tests at once: tables, pages and figures of `foamfit.study`."""
