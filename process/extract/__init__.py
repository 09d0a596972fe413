"""Stripe extraction: sub-pixel stripe centres from one frame."""
