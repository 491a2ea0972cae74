//! `rtnet router`.

mod confined;
mod figures;
mod keys;
mod shown;

use std::io::Write;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow, bail};
use package_router::name::Pattern;
use package_router::tcp::config::{Link, Listen, RouterFile};
use package_router::tcp::keys::{ClientKeys, RouterKeys};
use package_router::tcp::serve::{LinkTo, Remote, Server};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

use self::confined::confine;
use self::figures::figures;
use self::shown::describe;
use super::{Failure, print};
use crate::cli::{RouterArgs, RouterRunArgs, RouterVerb};
use crate::control::{self, Directory, Envelope, RouterReply, RouterRequest, RouterShown};
use crate::metrics;
use crate::remedy::explained;
use crate::scenario::read_text;
use crate::station::drop_capabilities;

const USUAL_NAME: &str = "router";
/// How often a router that nobody asks looks whether it is to end.
const LOOK_EVERY: Duration = Duration::from_millis(200);
/// How long its loop may take for an answer.
const PATIENCE: Duration = Duration::from_secs(2);

/// Runs a router until a signal ends it, or shows the status of one.
pub fn router(args: &RouterArgs) -> Result<u8, Failure> {
    match &args.verb {
        None => run(&args.run),
        Some(RouterVerb::Status { name, mailbox, all, json }) => {
            let directory = Directory::of_user().map_err(Failure::Usage)?;
            let shown = control::router_status(&directory, name, *mailbox).map_err(Failure::Usage)?;
            print(*json, &shown, |shown| describe(shown, mailbox.is_some(), *all)).map_err(Failure::Run)?;
            Ok(0)
        }
        Some(RouterVerb::Keys { directory, host }) => {
            keys::make(directory, host).map_err(Failure::Usage)?;
            Ok(0)
        }
    }
}

fn run(args: &RouterRunArgs) -> Result<u8, Failure> {
    let file = wanted(args).map_err(Failure::Usage)?;
    let name = file.name.as_deref().unwrap_or(USUAL_NAME);
    let [stop, again] = [(); 2].map(|()| Arc::new(AtomicBool::new(false)));
    let (mut server, mut control, _held) = set_up(&file, name, &stop).map_err(Failure::Usage)?;
    let bound = file.metrics.map(metrics::Bound::at).transpose().map_err(Failure::Usage)?;
    signal_hook::flag::register(SIGHUP, again.clone()).map_err(|error| Failure::Run(error.into()))?;
    [drop_capabilities(), keep_privileges_away(), confine(&file, args.file.as_deref(), control.path())]
        .into_iter()
        .flatten()
        .for_each(|line| tell(&line));
    let (remote, begun) = (server.remote(), Instant::now());
    if let Some(bound) = bound {
        let remote = remote.clone();
        let text = move || Some(figures(&remote.status(PATIENCE)?, begun.elapsed().as_secs_f64()));
        let at = bound.serve(text).map_err(Failure::Run)?;
        tell(&format!("figures for Prometheus are at http://{at}/metrics"));
    }
    let listen: Vec<String> = addresses(&server).map_err(Failure::Run)?;
    tell(&format!("router '{name}' listens at {}", listen.join(", ")));
    let routes = std::thread::Builder::new().name("router".into()).spawn(move || server.run());
    let routes = routes.context("a thread for the router").map_err(Failure::Run)?;
    while !stop.load(Ordering::Relaxed) && !routes.is_finished() {
        let status = |mailbox: Option<Pattern>| {
            let (up_ms, status) = (begun.elapsed().as_millis() as u64, remote.status(PATIENCE)?);
            Some(RouterShown::of(name, &listen, up_ms, &status, mailbox.as_ref()))
        };
        control.serve(LOOK_EVERY, |packet, _| Envelope::pack(answer(packet, status)));
        if again.swap(false, Ordering::Relaxed) {
            read_again(args, &remote);
        }
    }
    remote.stop();
    let ended =
        routes.join().map_err(|_| anyhow!("the router's thread has panicked")).map_err(Failure::Run)?;
    ended.context("the router's loop").map_err(Failure::Run)?;
    Ok(0)
}

/// The configuration: options count before the file.
fn wanted(args: &RouterRunArgs) -> Result<RouterFile> {
    let mut file = args.file.as_deref().map(read).transpose()?.unwrap_or_default();
    if !args.listen.is_empty() {
        let listen = |address: &SocketAddr| Listen { address: *address, keys: args.keys.clone() };
        file.listen = args.listen.iter().map(listen).collect();
    }
    file.insecure |= args.insecure;
    file.metrics = args.metrics.or(file.metrics);
    if let Some(name) = &args.name {
        file.name = Some(name.clone());
    }
    if let Some(name) = &file.name {
        control::parse_name(name).map_err(|why| anyhow!(why))?;
    }
    if let Some(exposed) = file.exposed() {
        bail!(
            "other hosts reach {exposed}, and nothing keeps a stranger from registering names there: listen on 127.0.0.1, or say \
             --insecure; or make keys (`rtnet router keys`), and say --keys"
        );
    }
    if let Some(router) = file.link_to_itself() {
        bail!(
            "the link to {router} leads to this router itself: give the address of another, or listen elsewhere"
        );
    }
    if let Some(at) = file.metrics.filter(|_| !file.insecure) {
        metrics::parse_loopback(&at.to_string()).map_err(|why| anyhow!(why))?;
    }
    Ok(file)
}

/// A file; keys that it names are looked for from where it is.
fn read(path: &Path) -> Result<RouterFile> {
    let name = path.display().to_string();
    let text = read_text(path).with_context(|| format!("{name} cannot be read"))?;
    let mut file = RouterFile::parse(&text, &name)?;
    let directory = path.parent().unwrap_or(Path::new(""));
    let of_listeners = file.listen.iter_mut().filter_map(|listen| listen.keys.as_mut());
    for keys in of_listeners.chain(file.links.iter_mut().filter_map(|link| link.keys.as_mut())) {
        *keys = directory.join(&*keys);
    }
    Ok(file)
}

/// The rules of its file, as it is now; if that cannot be, those before stay.
fn read_again(args: &RouterRunArgs, remote: &Remote) {
    match wanted(args) {
        Ok(file) => {
            // One that has ended needs none.
            let _ = remote.set_rules(file.rules);
            let what = if args.file.is_some() {
                "the rules were read again"
            } else {
                "it has no file to read again"
            };
            tell(&format!("{what}; all else is as at the start"));
        }
        Err(why) => {
            // One that has ended shows no status.
            let _ = remote.refuse_rules(format!("{why:#}"));
            tell(&format!("the rules stay as they were: {why:#}"));
        }
    }
}

/// A line for the person who started it, who may have closed standard error.
fn tell(line: &str) {
    let _ = writeln!(std::io::stderr(), "rtnet: {line}");
}

fn set_up(
    file: &RouterFile,
    name: &str,
    stop: &Arc<AtomicBool>,
) -> Result<(Server, control::Server, control::Held)> {
    let directory = Directory::of_user()?;
    let held = directory.take_router(name)?;
    let path = directory.router(name);
    let control = control::Server::bind(&path)?;
    let places: Vec<String> = file.listen.iter().map(|listen| listen.address.to_string()).collect();
    let with_keys = |Listen { address, keys }: &Listen| {
        keys.as_deref().map(RouterKeys::read).transpose().map(|keys| (*address, keys))
    };
    let listen = file.listen.iter().map(with_keys).collect::<Result<Vec<_>, _>>()?;
    let server = Server::listen(&listen, file.limits).map_err(explained);
    let server = server
        .with_context(|| format!("cannot listen at {} (choose another --listen)", places.join(", ")))?;
    let links = file.links.iter().map(link).collect::<Result<Vec<_>>>()?;
    let server = server.with_links(file.system, links);
    server.remote().set_rules(file.rules.clone()).context("its rules")?;
    for signal in [SIGINT, SIGTERM] {
        signal_hook::flag::register(signal, stop.clone())?;
    }
    Ok((server, control, held))
}

fn link(of: &Link) -> Result<LinkTo> {
    let keys = of.keys.as_deref().map(ClientKeys::read).transpose()?;
    Ok(LinkTo { router: of.router.clone(), keys, systems: of.systems.clone() })
}

/// No program that is run from here, by whatever error, gets more than this one has. A line if the kernel does not know that.
fn keep_privileges_away() -> Option<String> {
    let kept = nix::sys::prctl::set_no_new_privs();
    kept.err().map(|error| {
        format!("no_new_privs: {error}: a program with the set-user-ID bit could get more privileges")
    })
}

fn addresses(server: &Server) -> Result<Vec<String>> {
    Ok(server.addresses()?.iter().map(ToString::to_string).collect())
}

fn answer(packet: &[u8], status: impl Fn(Option<Pattern>) -> Option<RouterShown>) -> RouterReply {
    let mailbox = match control::read(packet) {
        Ok(RouterRequest::Status) => Ok(None),
        Ok(RouterRequest::StatusOf(pattern)) => pattern.parse().map(Some).map_err(|why| format!("{why}")),
        Err(why) => Err(why),
    };
    match mailbox.map(status) {
        Ok(Some(shown)) => RouterReply::Status(Box::new(shown)),
        Ok(None) => RouterReply::Refused("its loop has not answered in time".into()),
        Err(why) => RouterReply::Refused(why),
    }
}
