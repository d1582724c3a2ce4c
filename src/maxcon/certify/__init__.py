"""Checks anyone's result: recounts inliers, verifies a bound; calls no search."""

from maxcon.certify.certificate import Certificate, CertificateError, Group, load, save
from maxcon.certify.issue import issue
from maxcon.certify.rerun import Rerun
from maxcon.certify.verify import VerificationReport, verify

__all__ = [
    "Certificate",
    "CertificateError",
    "Group",
    "Rerun",
    "VerificationReport",
    "issue",
    "load",
    "save",
    "verify",
]
