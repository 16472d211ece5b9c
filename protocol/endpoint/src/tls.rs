//! Mutual TLS 1.3 with self-signed Ed25519 certificates, trusted by pinned public key and nothing else.

use std::sync::Arc;

use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::crypto::{CryptoProvider, ring, verify_tls13_signature};
use rustls::pki_types::{CertificateDer, ServerName, UnixTime};
use rustls::server::ParsedCertificate;
use rustls::server::danger::{ClientCertVerified, ClientCertVerifier};
use rustls::{
    CertificateError, DigitallySignedStruct, DistinguishedName, Error, PeerMisbehaved,
    SignatureScheme,
};

use crate::identity::{Fingerprint, Identity};
use crate::trust::{Standing, Trust};

/// Accepts a certificate if its public key is pinned; names, dates and issuers mean nothing here.
#[derive(Debug)]
struct Pinned {
    peers: Trust,
    provider: Arc<CryptoProvider>,
}

impl Pinned {
    fn new(peers: Trust) -> Arc<Self> {
        Arc::new(Self {
            peers,
            provider: Arc::new(ring::default_provider()),
        })
    }

    fn check(&self, certificate: &CertificateDer<'_>) -> Result<(), Error> {
        let spki = ParsedCertificate::try_from(certificate)?.subject_public_key_info();
        let refused = match self.peers.admits(Fingerprint::of_spki(&spki)) {
            Standing::Trusted => return Ok(()),
            Standing::Revoked => CertificateError::Revoked,
            Standing::Unknown => CertificateError::ApplicationVerificationFailure,
        };
        Err(Error::InvalidCertificate(refused))
    }

    fn signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        // rustls offers the schemes of `supported_verify_schemes` and does not look whether the peer kept to them.
        if signed.scheme != SignatureScheme::ED25519 {
            return Err(PeerMisbehaved::SignedHandshakeWithUnadvertisedSigScheme.into());
        }
        verify_tls13_signature(
            message,
            certificate,
            signed,
            &self.provider.signature_verification_algorithms,
        )
    }
}

fn no_tls12() -> Result<HandshakeSignatureValid, Error> {
    Err(Error::General("TLS 1.2 is not spoken".into()))
}

impl ServerCertVerifier for Pinned {
    fn verify_server_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        _intermediates: &[CertificateDer<'_>],
        _server_name: &ServerName<'_>,
        _ocsp_response: &[u8],
        _now: UnixTime,
    ) -> Result<ServerCertVerified, Error> {
        self.check(end_entity)
            .map(|()| ServerCertVerified::assertion())
    }

    fn verify_tls12_signature(
        &self,
        _message: &[u8],
        _cert: &CertificateDer<'_>,
        _dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        no_tls12()
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        cert: &CertificateDer<'_>,
        dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        self.signature(message, cert, dss)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        vec![SignatureScheme::ED25519]
    }
}

impl ClientCertVerifier for Pinned {
    fn root_hint_subjects(&self) -> &[DistinguishedName] {
        &[]
    }

    fn verify_client_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        _intermediates: &[CertificateDer<'_>],
        _now: UnixTime,
    ) -> Result<ClientCertVerified, Error> {
        self.check(end_entity)
            .map(|()| ClientCertVerified::assertion())
    }

    fn verify_tls12_signature(
        &self,
        _message: &[u8],
        _cert: &CertificateDer<'_>,
        _dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        no_tls12()
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        cert: &CertificateDer<'_>,
        dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        self.signature(message, cert, dss)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        vec![SignatureScheme::ED25519]
    }
}

/// The robot's side: accepts whom `peers` trusts and nobody else.
///
/// # Errors
/// [`Error`] if rustls rejects our own certificate.
pub fn server(
    identity: &Identity,
    peers: Trust,
    alpn: &[&[u8]],
) -> Result<rustls::ServerConfig, Error> {
    let verifier = Pinned::new(peers);
    let mut config = rustls::ServerConfig::builder_with_provider(verifier.provider.clone())
        .with_protocol_versions(&[&rustls::version::TLS13])?
        .with_client_cert_verifier(verifier)
        .with_single_cert(vec![identity.certificate()], identity.private_key())?;
    config.alpn_protocols = alpn.iter().map(|name| name.to_vec()).collect();
    // 0-RTT data can be replayed: no command may travel in it.
    config.max_early_data_size = 0;
    // A resumed session would not ask for the peer's key again, nor whether it is still trusted.
    config.session_storage = Arc::new(rustls::server::NoServerSessionStorage {});
    config.send_tls13_tickets = 0;
    Ok(config)
}

/// The operator's side: talks to whom `peer` trusts and nobody else.
///
/// # Errors
/// [`Error`] if rustls rejects our own certificate.
pub fn client(
    identity: &Identity,
    peer: Trust,
    alpn: &[&[u8]],
) -> Result<rustls::ClientConfig, Error> {
    let verifier = Pinned::new(peer);
    let mut config = rustls::ClientConfig::builder_with_provider(verifier.provider.clone())
        .with_protocol_versions(&[&rustls::version::TLS13])?
        .dangerous()
        .with_custom_certificate_verifier(verifier)
        .with_client_auth_cert(vec![identity.certificate()], identity.private_key())?;
    config.alpn_protocols = alpn.iter().map(|name| name.to_vec()).collect();
    config.enable_early_data = false;
    config.resumption = rustls::client::Resumption::disabled();
    Ok(config)
}

#[cfg(test)]
mod tests {
    use rcgen::{CertificateParams, KeyPair, PKCS_ECDSA_P256_SHA256, PKCS_ED25519};
    use rustls::client::ResolvesClientCert;
    use rustls::pki_types::PrivateKeyDer;
    use rustls::sign::{CertifiedKey, Signer, SigningKey};
    use rustls::{ClientConfig, ClientConnection, ServerConnection, SignatureAlgorithm};

    use super::*;

    /// Signs by its own scheme, whatever is asked for.
    #[derive(Debug)]
    struct Stubborn(Arc<dyn SigningKey>);

    impl SigningKey for Stubborn {
        fn choose_scheme(&self, _: &[SignatureScheme]) -> Option<Box<dyn Signer>> {
            use SignatureScheme::{ECDSA_NISTP256_SHA256, ED25519};
            self.0.choose_scheme(&[ED25519, ECDSA_NISTP256_SHA256])
        }

        fn algorithm(&self) -> SignatureAlgorithm {
            self.0.algorithm()
        }
    }

    #[derive(Debug)]
    struct Only(Arc<CertifiedKey>);

    impl ResolvesClientCert for Only {
        fn resolve(&self, _: &[&[u8]], _: &[SignatureScheme]) -> Option<Arc<CertifiedKey>> {
            Some(self.0.clone())
        }

        fn has_certs(&self) -> bool {
            true
        }
    }

    /// What a robot that trusts `key` makes of an operator that signs with it.
    fn greeted(key: &KeyPair) -> Result<(), Error> {
        let certificate = CertificateParams::default().self_signed(key).unwrap();
        let certificate = certificate.der().clone();
        let spki = ParsedCertificate::try_from(&certificate)
            .unwrap()
            .subject_public_key_info();
        let robot = Identity::ephemeral().unwrap();
        let trusted = Trust::new([Fingerprint::of_spki(&spki)]);
        let verifier = Pinned::new(Trust::new([robot.fingerprint()]));
        let private = PrivateKeyDer::try_from(key.serialize_der()).unwrap();
        let signing = verifier.provider.key_provider.load_private_key(private);
        let signing = Arc::new(Stubborn(signing.unwrap()));
        let own = CertifiedKey::new(vec![certificate], signing);
        let config = ClientConfig::builder_with_provider(verifier.provider.clone())
            .with_protocol_versions(&[&rustls::version::TLS13])
            .unwrap()
            .dangerous()
            .with_custom_certificate_verifier(verifier)
            .with_client_cert_resolver(Arc::new(Only(Arc::new(own))));
        let config = Arc::new(config);
        let name = ServerName::try_from("telemime").unwrap();
        let mut operator = ClientConnection::new(config, name).unwrap();
        let config = Arc::new(server(&robot, trusted, &[]).unwrap());
        let mut robot = ServerConnection::new(config).unwrap();
        while operator.is_handshaking() || robot.is_handshaking() {
            let mut said = Vec::new();
            operator.write_tls(&mut said).unwrap();
            robot.read_tls(&mut &said[..]).unwrap();
            robot.process_new_packets()?;
            said.clear();
            robot.write_tls(&mut said).unwrap();
            operator.read_tls(&mut &said[..]).unwrap();
            operator.process_new_packets().unwrap();
        }
        Ok(())
    }

    #[test]
    fn a_trusted_key_of_another_scheme_is_refused() {
        let key = |algorithm| KeyPair::generate_for(algorithm).unwrap();
        assert_eq!(greeted(&key(&PKCS_ED25519)), Ok(()));
        let unasked = PeerMisbehaved::SignedHandshakeWithUnadvertisedSigScheme;
        assert_eq!(greeted(&key(&PKCS_ECDSA_P256_SHA256)), Err(unasked.into()));
    }
}
