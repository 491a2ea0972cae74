//! `rtnet router keys`: an authority, a certificate for the router and one for its clients, and a secret.

use std::fs::{self, DirBuilder, OpenOptions};
use std::io::Write;
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
use std::path::Path;

use anyhow::{Context, Result};
use rcgen::{
    BasicConstraints, CertificateParams, CertifiedIssuer, DnType, ExtendedKeyUsagePurpose, IsCa, KeyPair,
    KeyUsagePurpose,
};

/// Hosts by which a router is reached unless others are named.
const USUAL_HOSTS: [&str; 3] = ["localhost", "127.0.0.1", "::1"];
/// Bytes of a secret, which are written as twice as many digits.
const SECRET: usize = 32;

/// Makes them in a directory that is not there yet.
pub fn make(directory: &Path, hosts: &[String]) -> Result<()> {
    let hosts = match hosts {
        [] => USUAL_HOSTS.map(str::to_owned).to_vec(),
        hosts => hosts.to_vec(),
    };
    let authority = authority()?;
    let (router, router_key) = signed(&authority, "router", hosts, ExtendedKeyUsagePurpose::ServerAuth)?;
    let (client, client_key) = signed(&authority, "client", Vec::new(), ExtendedKeyUsagePurpose::ClientAuth)?;
    let secret = hex(&random()?);

    let [of_router, of_client] = ["router", "client"].map(|whose| directory.join(whose));
    for place in [directory, &of_router, &of_client] {
        let made = DirBuilder::new().mode(0o700).create(place);
        made.with_context(|| {
            format!("{}: keys are made in a directory that is not there yet", place.display())
        })?;
    }
    let ca = authority.pem();
    write(&directory.join("ca.key"), &authority.key().serialize_pem())?;
    for (place, whose, certificate, key) in
        [(&of_router, "router", router, router_key), (&of_client, "client", client, client_key)]
    {
        write(&place.join("ca.pem"), &ca)?;
        write(&place.join(format!("{whose}.pem")), &certificate)?;
        write(&place.join(format!("{whose}.key")), &key)?;
        write(&place.join("secret"), &secret)?;
    }
    Ok(())
}

fn authority() -> Result<CertifiedIssuer<'static, KeyPair>> {
    let mut of = CertificateParams::default();
    of.distinguished_name.push(DnType::CommonName, "rtnet router authority");
    of.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    of.key_usages = vec![KeyUsagePurpose::KeyCertSign];
    Ok(CertifiedIssuer::self_signed(of, KeyPair::generate()?)?)
}

/// A certificate for these hosts, and its private key.
fn signed(
    authority: &CertifiedIssuer<'static, KeyPair>,
    whose: &str,
    hosts: Vec<String>,
    purpose: ExtendedKeyUsagePurpose,
) -> Result<(String, String)> {
    let mut of = CertificateParams::new(hosts).context("--host")?;
    // Python 3.13 and later refuse a certificate that does not name the key of its authority.
    of.use_authority_key_identifier_extension = true;
    of.distinguished_name.push(DnType::CommonName, format!("rtnet {whose}"));
    of.extended_key_usages = vec![purpose];
    of.key_usages = vec![KeyUsagePurpose::DigitalSignature];
    let key = KeyPair::generate()?;
    let certificate = of.signed_by(&key, authority)?;
    Ok((certificate.pem(), key.serialize_pem()))
}

/// Bytes of the kernel's, which nobody can guess.
fn random() -> Result<[u8; SECRET]> {
    let mut bytes = [0; SECRET];
    std::io::Read::read_exact(&mut fs::File::open("/dev/urandom")?, &mut bytes)?;
    Ok(bytes)
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect::<String>() + "\n"
}

/// Nobody else may read it.
fn write(file: &Path, text: &str) -> Result<()> {
    let opened = OpenOptions::new().write(true).create_new(true).mode(0o600).open(file);
    let written = opened.and_then(|mut file| file.write_all(text.as_bytes()));
    written.with_context(|| file.display().to_string())
}
