//! The shell of an observer: the ring, the kernel's two clocks, and when to stop. It has no way to send.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow, bail};
use rtnet::clock::True;
use rtnet::live::clock::WallClock;
use rtnet::live::interface::Interface;
use rtnet::live::ring::{CaptureRing, Captured, RingConfig};
use rtnet::wire::ethernet::Address;

use crate::control::{Directory, lab_status};
use crate::lab::enter::enter;

/// How long nothing is looked at when nothing comes.
const LOOK_EVERY: Duration = Duration::from_millis(50);
/// Frames that the kernel stamped before a step of the wall clock may still come out of the ring for so long.
const DISTRUST: Duration = Duration::from_millis(100);

/// Where to listen.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Spot {
    /// On an interface of this network namespace.
    Interface(String),
    /// On the bridge of a lab.
    Lab(String),
}

/// An open ear.
pub struct Ear {
    /// The interface that is listened on.
    pub interface: String,
    /// The lab whose bridge that is.
    pub lab: Option<String>,
    /// The lab's stations, by address.
    pub names: BTreeMap<Address, String>,
    /// What goes when the lab does.
    sign_of_life: Option<PathBuf>,
    ring: CaptureRing,
    wall: WallClock,
    distrusted_until: Option<Instant>,
    interrupted: Arc<AtomicBool>,
}

impl Ear {
    /// Opens the ring, in the lab's namespace if it is a lab's: that takes a process of one thread.
    ///
    /// # Errors
    /// No such interface or lab, or no privileges: what, where, and what to do.
    pub fn open(spot: &Spot) -> Result<Self> {
        let interrupted = Arc::new(AtomicBool::new(false));
        for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
            signal_hook::flag::register(signal, interrupted.clone())?;
        }
        let (interface, lab) = match spot {
            Spot::Interface(name) => (Interface::find(name)?.name, None),
            Spot::Lab(name) => {
                // To be asked before a user namespace is entered, in which one is root.
                let status = lab_status(&Directory::of_user()?, name)?;
                enter(status.pid, &status.bridge_namespace).with_context(|| format!("lab '{name}'"))?;
                (status.bridge.clone(), Some(status))
            }
        };
        let ring = CaptureRing::open(&interface, RingConfig::default()).map_err(explain)?;
        let stations = lab.iter().flat_map(|lab| &lab.stations);
        let names = stations.filter_map(|s| Some((s.address.parse().ok()?, s.name.clone()))).collect();
        Ok(Self {
            interface,
            names,
            sign_of_life: lab.as_ref().map(|lab| lab.bridge_namespace.clone()),
            lab: lab.map(|lab| lab.name),
            ring,
            wall: WallClock::default(),
            distrusted_until: None,
            interrupted,
        })
    }

    /// Waits a little, and hands over what frames came, each with its moment if its stamp can be trusted.
    /// Whether to go on.
    ///
    /// # Errors
    /// The interface went down, or the lab away.
    pub fn listen(&mut self, mut f: impl FnMut(Option<True>, &Captured<'_>)) -> Result<bool> {
        self.ring.wait(LOOK_EVERY)?;
        if !self.wall.sample() {
            self.distrusted_until = Some(Instant::now() + DISTRUST);
        }
        let trusted = self.distrusted_until.is_none_or(|until| Instant::now() > until);
        let Self { ring, wall, .. } = self;
        ring.drain(|frame| f(trusted.then(|| wall.truth(frame.realtime_ns)), &frame));
        if let Some(sign) = &self.sign_of_life
            && sign.symlink_metadata().is_err()
        {
            bail!("the lab has ended");
        }
        Ok(!self.interrupted.load(Ordering::Relaxed))
    }

    /// Frames that the ring lost, since it was opened.
    pub fn dropped(&mut self) -> u64 {
        self.ring.dropped().unwrap_or(0) + self.ring.unreadable()
    }

    /// Steps of the wall clock, since it was opened.
    pub fn clock_steps(&self) -> u64 {
        self.wall.steps()
    }

    /// Where it listens, in words.
    pub fn place(&self) -> String {
        match &self.lab {
            Some(lab) => format!("{} of lab '{lab}'", self.interface),
            None => self.interface.clone(),
        }
    }
}

/// Says what to do where the kernel only says no.
fn explain(error: std::io::Error) -> anyhow::Error {
    match error.kind() {
        std::io::ErrorKind::PermissionDenied => {
            anyhow!("{error}: or listen in a lab of your own (--lab)")
        }
        _ => error.into(),
    }
}
