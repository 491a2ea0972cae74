//! Keys by which a router and its clients know each other: a directory each, as `rtnet router keys` makes them.
//!
//! ```text
//! ca.pem                    the authority that has signed the certificates of the router and of clients
//! router.pem  router.key    a router's certificate, and its private key
//! client.pem  client.key    a client's
//! secret                    known to the router, and to clients that may come without a certificate
//! ```
//!
//! A client has a certificate of the authority, or proves that it knows the secret: its first package is an HMAC of that over a value that
//! only the two ends of this session can know (RFC 5705), so that nobody can use it in another session.

use core::fmt;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use ring::hmac;
use rustls::client::WebPkiServerVerifier;
use rustls::crypto::CryptoProvider;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use rustls::server::{VerifierBuilderError, WebPkiClientVerifier};
use rustls::{ClientConfig, ClientConnection, Connection, RootCertStore, ServerConfig, ServerConnection};

use super::control::Proof;

/// The label of the value over which the proof is made.
const LABEL: &[u8] = b"EXPORTER-rtnet-router-secret";
/// A secret has as many bytes, at the least: fewer could be guessed.
pub const SECRET_AT_LEAST: usize = 16;

/// Keys that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum KeysError {
    /// A file cannot be read.
    #[error("{0}: {1}: `rtnet router keys` makes such a directory")]
    Unreadable(PathBuf, io::Error),
    /// A file holds something else.
    #[error("{0}: {1}: `rtnet router keys` makes such a file")]
    Wrong(PathBuf, String),
    /// A router's keys by which anybody could connect.
    #[error("{0} has neither ca.pem nor a secret: anybody could connect; copy one of them there")]
    Open(PathBuf),
    /// A client's keys with which no router takes it.
    #[error(
        "{0} has neither client.pem nor a secret: no router takes it; copy client.pem and client.key, or secret, there"
    )]
    Nothing(PathBuf),
    /// They do not belong together.
    #[error("{0}: {1}: take all files from one directory that `rtnet router keys` has made")]
    Mismatch(PathBuf, rustls::Error),
}

/// A router's keys.
#[derive(Clone)]
pub struct RouterKeys {
    config: Arc<ServerConfig>,
    secret: Option<hmac::Key>,
}

/// A client's keys.
#[derive(Clone)]
pub struct ClientKeys {
    config: Arc<ClientConfig>,
    secret: Option<hmac::Key>,
}

impl RouterKeys {
    /// Reads them.
    pub fn read(directory: &Path) -> Result<Self, KeysError> {
        let (secret, roots) = (secret(directory)?, roots(directory)?);
        let (chain, key) = identity(directory, "router")?;
        let builder = ServerConfig::builder_with_provider(provider())
            .with_safe_default_protocol_versions()
            .map_err(|error| KeysError::Mismatch(directory.into(), error))?;
        let builder = match roots {
            None if secret.is_none() => return Err(KeysError::Open(directory.into())),
            None => builder.with_no_client_auth(),
            Some(roots) => {
                let verifier = WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider());
                let verifier = if secret.is_some() { verifier.allow_unauthenticated() } else { verifier };
                builder.with_client_cert_verifier(verifier.build().map_err(|error| {
                    KeysError::Wrong(directory.join("ca.pem"), VerifierBuilderError::to_string(&error))
                })?)
            }
        };
        let config = builder.with_single_cert(chain, key);
        let config = config.map_err(|error| KeysError::Mismatch(directory.join("router.pem"), error))?;
        Ok(Self { config: Arc::new(config), secret })
    }

    /// A session with a client, which has not begun.
    pub fn session(&self) -> Result<ServerConnection, rustls::Error> {
        ServerConnection::new(self.config.clone())
    }

    /// The proof that the client of a session has to give, once that has begun; `None`: its certificate is enough.
    pub fn proof(&self, session: &Connection) -> Result<Option<Proof>, rustls::Error> {
        let secret = self.secret.as_ref().filter(|_| session.peer_certificates().is_none());
        secret.map(|secret| proof(secret, session)).transpose()
    }
}

impl ClientKeys {
    /// Reads them.
    pub fn read(directory: &Path) -> Result<Self, KeysError> {
        let secret = secret(directory)?;
        let authority = directory.join("ca.pem");
        let missing = || KeysError::Unreadable(authority.clone(), io::Error::from_raw_os_error(libc::ENOENT));
        let roots = Arc::new(roots(directory)?.ok_or_else(missing)?);
        let verifier = WebPkiServerVerifier::builder_with_provider(roots, provider()).build();
        let verifier = verifier.map_err(|error| KeysError::Wrong(authority, error.to_string()))?;
        let builder = ClientConfig::builder_with_provider(provider())
            .with_safe_default_protocol_versions()
            .map_err(|error| KeysError::Mismatch(directory.into(), error))?
            .with_webpki_verifier(verifier);
        let has_certificate = directory.join("client.pem").exists();
        let config = match (has_certificate, &secret) {
            (false, None) => return Err(KeysError::Nothing(directory.into())),
            (false, Some(_)) => builder.with_no_client_auth(),
            (true, _) => {
                let (chain, key) = identity(directory, "client")?;
                let config = builder.with_client_auth_cert(chain, key);
                config.map_err(|error| KeysError::Mismatch(directory.join("client.pem"), error))?
            }
        };
        // A router that takes the secret only asks for no certificate.
        Ok(Self { config: Arc::new(config), secret })
    }

    /// A session with the router on this host, which has not begun. The router's certificate has to name that host.
    pub fn session(&self, host: &str) -> Result<ClientConnection, rustls::Error> {
        let name = ServerName::try_from(host.to_owned())
            .map_err(|error| rustls::Error::General(error.to_string()))?;
        ClientConnection::new(self.config.clone(), name)
    }

    /// The proof with which a session begins, if it needs one.
    pub fn proof(&self, session: &Connection) -> Result<Option<Proof>, rustls::Error> {
        self.secret.as_ref().map(|secret| proof(secret, session)).transpose()
    }
}

/// Secrets are not shown.
impl fmt::Debug for ClientKeys {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ClientKeys").finish_non_exhaustive()
    }
}

fn proof(secret: &hmac::Key, session: &Connection) -> Result<Proof, rustls::Error> {
    let value = session.export_keying_material(Proof::default(), LABEL, None)?;
    let mut proof = Proof::default();
    proof.copy_from_slice(hmac::sign(secret, &value).as_ref());
    Ok(proof)
}

fn provider() -> Arc<CryptoProvider> {
    Arc::new(rustls::crypto::ring::default_provider())
}

/// The secret, if the directory has one.
fn secret(directory: &Path) -> Result<Option<hmac::Key>, KeysError> {
    let file = directory.join("secret");
    let bytes = match fs::read(&file) {
        Ok(bytes) => bytes,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(KeysError::Unreadable(file, error)),
    };
    let text = bytes.trim_ascii();
    if text.len() < SECRET_AT_LEAST {
        let what =
            format!("a secret of {} bytes could be guessed: make it {SECRET_AT_LEAST} or more", text.len());
        return Err(KeysError::Wrong(file, what));
    }
    Ok(Some(hmac::Key::new(hmac::HMAC_SHA256, text)))
}

/// The authority, if the directory has one.
fn roots(directory: &Path) -> Result<Option<RootCertStore>, KeysError> {
    let file = directory.join("ca.pem");
    if !file.exists() {
        return Ok(None);
    }
    let mut roots = RootCertStore::empty();
    for certificate in certificates(&file)? {
        roots.add(certificate).map_err(|error| KeysError::Wrong(file.clone(), error.to_string()))?;
    }
    Ok(Some(roots))
}

/// A certificate with its chain, and its private key.
fn identity(
    directory: &Path,
    whose: &str,
) -> Result<(Vec<CertificateDer<'static>>, PrivateKeyDer<'static>), KeysError> {
    let chain = certificates(&directory.join(format!("{whose}.pem")))?;
    let file = directory.join(format!("{whose}.key"));
    let key = PrivateKeyDer::from_pem_file(&file).map_err(|error| of_pem(&file, error))?;
    Ok((chain, key))
}

fn certificates(file: &Path) -> Result<Vec<CertificateDer<'static>>, KeysError> {
    let all = CertificateDer::pem_file_iter(file).and_then(Iterator::collect::<Result<Vec<_>, _>>);
    let all = all.map_err(|error| of_pem(file, error))?;
    match all.is_empty() {
        true => Err(KeysError::Wrong(file.into(), "it holds no certificate".into())),
        false => Ok(all),
    }
}

fn of_pem(file: &Path, error: rustls::pki_types::pem::Error) -> KeysError {
    match error {
        rustls::pki_types::pem::Error::Io(error) => KeysError::Unreadable(file.into(), error),
        error => KeysError::Wrong(file.into(), format!("it holds no key or certificate in PEM: {error}")),
    }
}
