"""Estimation of calibration parts: arrays and documents in, documents with covariance out."""
