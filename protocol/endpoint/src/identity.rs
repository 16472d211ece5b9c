//! An Ed25519 key and the fingerprint a peer pins.

use std::fmt;
use std::io::Write;
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use rcgen::{CertificateParams, KeyPair, PKCS_ED25519, PublicKeyData};
use ring::hmac;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, PrivatePkcs8KeyDer};
use sha2::{Digest, Sha256};

/// SHA-256 of a peer's SubjectPublicKeyInfo (RFC 7469 §2.4's pin), written as 64 hexadecimal digits.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Fingerprint([u8; 32]);

impl Fingerprint {
    /// The fingerprint of a DER-encoded SubjectPublicKeyInfo.
    pub fn of_spki(spki: &[u8]) -> Self {
        Self(Sha256::digest(spki).into())
    }

    /// The 32 bytes of the hash.
    pub fn bytes(&self) -> [u8; 32] {
        self.0
    }

    /// The first 80 bits in four groups of four letters and digits (RFC 4648's base 32, lower case): for people
    /// to tell keys apart by. A search for another key with the same 80 bits is out of reach.
    pub fn short(&self) -> String {
        const ALPHABET: &[u8; 32] = b"abcdefghijklmnopqrstuvwxyz234567";
        let mut bits = [0; 16];
        bits[6..].copy_from_slice(&self.0[..10]);
        let bits = u128::from_be_bytes(bits);
        let mut out = String::with_capacity(19);
        for i in 0..16 {
            if i > 0 && i % 4 == 0 {
                out.push('-');
            }
            out.push(char::from(ALPHABET[(bits >> (75 - 5 * i)) as usize & 31]));
        }
        out
    }
}

impl fmt::Display for Fingerprint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for Fingerprint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl FromStr for Fingerprint {
    type Err = IdentityError;

    fn from_str(text: &str) -> Result<Self, IdentityError> {
        let wrong = || IdentityError::Fingerprint(text.to_owned());
        if text.len() != 64 || !text.bytes().all(|b| b.is_ascii_hexdigit()) {
            return Err(wrong());
        }
        let mut bytes = [0; 32];
        for (i, byte) in bytes.iter_mut().enumerate() {
            *byte = u8::from_str_radix(&text[2 * i..2 * i + 2], 16).map_err(|_| wrong())?;
        }
        Ok(Self(bytes))
    }
}

/// Why there is no identity.
#[derive(Debug, thiserror::Error)]
pub enum IdentityError {
    /// The key file cannot be read or written.
    #[error("key file {path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// Others may read the key file.
    #[error(
        "key file {path} has mode {mode:04o}: others may read it; run `chmod 600 {path}`, or make a new key"
    )]
    Permissions {
        /// The file.
        path: PathBuf,
        /// Its permission bits.
        mode: u32,
    },
    /// The file holds no Ed25519 key.
    #[error(
        "key file {path} holds no Ed25519 private key in PEM form: move it away, a new key is made at the next start"
    )]
    NotAKey {
        /// The file.
        path: PathBuf,
    },
    /// Not a fingerprint.
    #[error(
        "`{0}` is not a fingerprint: 64 hexadecimal digits, as the other daemon prints at its start"
    )]
    Fingerprint(String),
    /// The key cannot sign its certificate.
    #[error("certificate: {0}")]
    Certificate(#[from] rcgen::Error),
}

/// A daemon's key and its self-signed certificate.
pub struct Identity {
    key: KeyPair,
    certificate: CertificateDer<'static>,
}

impl fmt::Debug for Identity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Identity({})", self.fingerprint())
    }
}

impl Identity {
    /// A key that exists in memory only.
    ///
    /// # Errors
    /// [`IdentityError::Certificate`] if the system gives no randomness.
    pub fn ephemeral() -> Result<Self, IdentityError> {
        Self::from_key(KeyPair::generate_for(&PKCS_ED25519)?)
    }

    /// An identity from a PEM text.
    ///
    /// # Errors
    /// [`IdentityError::Certificate`] if it holds no Ed25519 key.
    pub fn from_pem(pem: &str) -> Result<Self, IdentityError> {
        Self::from_key(KeyPair::from_pkcs8_pem_and_sign_algo(pem, &PKCS_ED25519)?)
    }

    /// The private key as a PEM text: to be kept as carefully as the key itself.
    pub fn to_pem(&self) -> String {
        self.key.serialize_pem()
    }

    /// Reads the key at `path`, or makes one there (mode 0600) at the first start.
    ///
    /// # Errors
    /// [`IdentityError`]: unreadable, readable by others, or not a key. An existing file is never replaced.
    pub fn load_or_create(path: &Path) -> Result<Self, IdentityError> {
        let io = |source| IdentityError::Io {
            path: path.to_owned(),
            source,
        };
        match std::fs::read_to_string(path) {
            Ok(pem) => {
                let mode = std::fs::metadata(path).map_err(io)?.permissions().mode() & 0o777;
                if mode & 0o077 != 0 {
                    return Err(IdentityError::Permissions {
                        path: path.to_owned(),
                        mode,
                    });
                }
                Self::from_pem(&pem).map_err(|_| IdentityError::NotAKey {
                    path: path.to_owned(),
                })
            }
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => {
                let identity = Self::ephemeral()?;
                identity.save(path)?;
                Ok(identity)
            }
            Err(e) => Err(io(e)),
        }
    }

    /// Writes the key to a new file with mode 0600.
    ///
    /// # Errors
    /// [`IdentityError::Io`]; also if the file exists.
    pub fn save(&self, path: &Path) -> Result<(), IdentityError> {
        let io = |source| IdentityError::Io {
            path: path.to_owned(),
            source,
        };
        if let Some(folder) = path.parent().filter(|p| !p.as_os_str().is_empty()) {
            std::fs::create_dir_all(folder).map_err(io)?;
        }
        let mut file = std::fs::OpenOptions::new()
            .write(true)
            .create_new(true)
            .mode(0o600)
            .open(path)
            .map_err(io)?;
        file.write_all(self.to_pem().as_bytes())
            .and_then(|()| file.sync_all())
            .map_err(io)
    }

    /// What the peer pins.
    pub fn fingerprint(&self) -> Fingerprint {
        Fingerprint::of_spki(&self.key.subject_public_key_info())
    }

    pub(crate) fn certificate(&self) -> CertificateDer<'static> {
        self.certificate.clone()
    }

    pub(crate) fn private_key(&self) -> PrivateKeyDer<'static> {
        PrivateKeyDer::Pkcs8(PrivatePkcs8KeyDer::from(self.key.serialize_der()))
    }

    /// The secret that QUIC's stateless reset tokens are made with; it follows from the private key.
    pub(crate) fn reset_key(&self) -> hmac::Key {
        let private = hmac::Key::new(hmac::HMAC_SHA256, &self.key.serialize_der());
        let secret = hmac::sign(&private, b"telemime stateless reset");
        hmac::Key::new(hmac::HMAC_SHA256, secret.as_ref())
    }

    fn from_key(key: KeyPair) -> Result<Self, IdentityError> {
        // Serial number and dates are fixed by rcgen's defaults, so the certificate follows from the key alone.
        let certificate = CertificateParams::new(vec!["telemime".to_owned()])?
            .self_signed(&key)?
            .der()
            .clone();
        Ok(Self { key, certificate })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_is_made_once_private_and_kept() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("keys/robot.key");
        let first = Identity::load_or_create(&path).unwrap();
        assert_eq!(
            std::fs::metadata(&path).unwrap().permissions().mode() & 0o777,
            0o600
        );
        let second = Identity::load_or_create(&path).unwrap();
        assert_eq!(first.fingerprint(), second.fingerprint());
        assert_eq!(first.certificate(), second.certificate());
        let text = first.fingerprint().to_string();
        assert_eq!(text.parse::<Fingerprint>().unwrap(), first.fingerprint());
    }

    #[test]
    fn an_open_or_damaged_key_is_refused_and_not_replaced() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("robot.key");
        Identity::load_or_create(&path).unwrap();
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o644)).unwrap();
        assert!(matches!(
            Identity::load_or_create(&path),
            Err(IdentityError::Permissions { mode: 0o644, .. })
        ));
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o600)).unwrap();
        std::fs::write(&path, "not a key").unwrap();
        assert!(matches!(
            Identity::load_or_create(&path),
            Err(IdentityError::NotAKey { .. })
        ));
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "not a key");
    }

    #[test]
    fn fingerprints_are_parsed_or_refused() {
        // RFC 4648: ten bytes of ff are sixteen times the last letter.
        assert_eq!(Fingerprint([0xff; 32]).short(), "7777-7777-7777-7777");
        assert_eq!(
            Fingerprint(*b"foobarfoobarfoobarfoobarfoobarfo").short(),
            "mzxw-6ytb-ojtg-633c"
        );
        for bad in ["", "12", &"g".repeat(64), &"é".repeat(32)] {
            assert!(bad.parse::<Fingerprint>().is_err(), "{bad}");
        }
    }
}
