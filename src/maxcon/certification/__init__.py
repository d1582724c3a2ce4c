"""Checks anyone's result: recounts inliers, verifies a bound; calls no search."""

from maxcon.certification.certificate import Certificate, CertificateError, Group, load, save
from maxcon.certification.issue import issue
from maxcon.certification.rerun import Rerun
from maxcon.certification.verify import VerificationReport, verify

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
