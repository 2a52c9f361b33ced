"""Models of sensor imperfections: noise, sampling rate, latency, dropout."""
