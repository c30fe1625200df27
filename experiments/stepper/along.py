class Prepared: pass
