//! Programs in processes of their own, and where their station lets them in.

use std::any::Any;
use std::io::{BufRead, BufReader, ErrorKind, Read};
use std::net::{Ipv4Addr, Shutdown, SocketAddrV4};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use rtnet::api::Station;
use rtnet::api::client::UdpSocket;
use rtnet::api::door::{self, Attached, Door, Visit};
use rtnet::api::handshake::{self, Answer, Ask};
use rtnet::live::clock::monotonic;
use rtnet::live::realtime::RealTime;
use rtnet::live::{Visitor, Visits};
use rtnet::socket::{Flags, Sender};
use serde_json::Value;
use socket2::{Domain, SockAddr, Socket, Type};
use tests::stacks::{at, ip};
use tools::lab::namespace::Namespace;

use crate::figures::Times;
use crate::programs::{Echo, PORT, message, number_of};
use crate::stations::{Plan, Running};
use crate::{Cores, MESSAGE, PATIENCE, PROGRAM_PRIORITY, WARM_UP, Way};

/// How often to look whether a station has carried out what it was asked.
const LOOK_EVERY: Duration = Duration::from_millis(1);

/// Where one program at a time gets a socket of a station's, as in `tools::control`.
pub struct Gate {
    path: PathBuf,
    listener: Arc<Socket>,
    thread: Option<JoinHandle<()>>,
}

impl Gate {
    pub fn open(path: PathBuf, door: Door, visits: Arc<Visits>) -> Result<Self> {
        let listener = Arc::new(Socket::new(Domain::UNIX, Type::SEQPACKET, None)?);
        listener.bind(&SockAddr::unix(&path)?)?;
        listener.listen(1)?;
        let accepts = listener.clone();
        let thread = std::thread::spawn(move || Keeper { door, visits }.let_in(&accepts));
        Ok(Self { path, listener, thread: Some(thread) })
    }

    pub fn path(&self) -> &Path {
        &self.path
    }
}

impl Drop for Gate {
    fn drop(&mut self) {
        // Whoever accepts is woken by it.
        let _ = self.listener.shutdown(Shutdown::Both);
        self.thread.take().into_iter().for_each(|thread| drop(thread.join()));
    }
}

struct Keeper {
    door: Door,
    visits: Arc<Visits>,
}

impl Keeper {
    fn let_in(&mut self, listener: &Socket) {
        while let Ok((mut program, _)) = listener.accept() {
            let (mut attached, mut packet) = (None, [0; handshake::ASK_LEN + 1]);
            while let Ok(length @ 1..) = program.read(&mut packet) {
                self.serve(&program, &packet[..length], &mut attached);
            }
            if let Some(left) = attached {
                let visit = self.door.leave(left);
                let visit = self.carry_out(visit);
                self.door.finish(visit);
            }
        }
    }

    fn serve(&mut self, program: &Socket, packet: &[u8], attached: &mut Option<Attached>) {
        let Some(ask) = Ask::parse(packet) else { return };
        let (answer, opened): (Answer, _) = match self.door.prepare(ask, attached.as_ref()) {
            Ok(visit) => {
                let visit = self.carry_out(visit);
                self.door.finish(visit)
            }
            Err(answer) => (answer, None),
        };
        let descriptors = opened.as_ref().map(|(_, descriptors)| descriptors);
        // Who has gone is seen to have when it is read from.
        let _ = door::reply(program, &answer, descriptors);
        if let Some((socket, _)) = opened {
            *attached = Some(socket);
        }
    }

    fn carry_out(&self, visit: Visit) -> Visit {
        assert!(self.visits.send(Box::new(visit)).is_ok(), "one at a time");
        loop {
            if let Some(errand) = self.visits.take() {
                let visitor: Box<dyn Visitor> = errand.command;
                let visitor: Box<dyn Any> = visitor;
                return *visitor.downcast().expect("it is the one that was sent");
            }
            std::thread::sleep(LOOK_EVERY);
        }
    }
}

/// A process of this program, which is killed when it is not needed any more.
struct Process(Child);

impl Process {
    fn start(arguments: &[&str]) -> Result<Self> {
        let mut command = Command::new(std::env::current_exe()?);
        command.args(arguments).stdin(Stdio::null()).stdout(Stdio::piped());
        Ok(Self(command.spawn().context("a program")?))
    }

    /// The next line that it says.
    fn line(&mut self) -> Result<String> {
        let mut line = String::new();
        BufReader::new(self.0.stdout.as_mut().context("its output")?).read_line(&mut line)?;
        ensure!(!line.is_empty(), "a program has ended without a word");
        Ok(line)
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// There and back between two programs, each of its own station.
pub fn trips(homes: &[Namespace; 2], way: Way, cores: (Cores, Cores), time: Duration) -> Result<Value> {
    let (stations, programs) = cores;
    let plan =
        |number| Plan { namespace: &homes[number], number, core: stations[number], way, is_open: true };
    let answers = Running::without_slots(plan(1), Vec::new())?;
    let asks = Running::without_slots(plan(0), Vec::new())?;
    let core = programs.map(|core| core.to_string());
    let mut echoes = Process::start(&["echoes", of(&answers)?, way.name(), &core[1]])?;
    echoes.line()?;
    let time = time.as_secs_f64().to_string();
    let mut pings = Process::start(&["pings", of(&asks)?, way.name(), &core[0], &time])?;
    Ok(serde_json::from_str(&pings.line()?)?)
}

/// There and back between a program and the echo in its station's own thread: nobody sleeps.
pub fn alone(home: &Namespace, cores: Cores, time: Duration) -> Result<Value> {
    // The other number: what is asked is where the peer would be.
    let plan = Plan { namespace: home, number: 1, core: cores[1], way: Way::Spin, is_open: true };
    let station = Running::without_slots(plan, vec![Echo::new()])?;
    let (core, time) = (cores[0].to_string(), time.as_secs_f64().to_string());
    let mut pings = Process::start(&["pings", of(&station)?, Way::Spin.name(), &core, &time])?;
    Ok(serde_json::from_str(&pings.line()?)?)
}

fn of(station: &Running) -> Result<&str> {
    station.path()?.to_str().context("a path that can be written")
}

/// In a process of its own: asks until the time is over.
pub fn pings(path: &str, way: Way, core: usize, time: Duration) -> Result<Value> {
    let socket = set_up(path, way, core)?;
    let mut times = Times::new();
    let (begun, mut number, mut is_warm) = (monotonic(), 0, false);
    let (warm, over) = (WARM_UP.as_nanos() as u64, (WARM_UP + time).as_nanos() as u64);
    loop {
        let asked = monotonic();
        if asked - begun > over {
            return Ok(times.figures());
        }
        if !is_warm && asked - begun > warm {
            is_warm = true;
            times.clear();
        }
        number += 1;
        socket.send_to(&message(number), at(1, PORT))?;
        match answered(&socket, way, number, asked)? {
            Some(took) => times.note(took),
            None => times.note_lost(),
        }
    }
}

/// How long it took until the answer came.
fn answered(socket: &UdpSocket, way: Way, number: u64, asked: u64) -> Result<Option<u64>> {
    let mut room = [0; MESSAGE];
    loop {
        let received = match way {
            Way::Block => socket.receive(&mut room),
            Way::Spin => socket.receive_with(&mut room, Flags::DONTWAIT),
        };
        match received {
            Ok(_) if number_of(&room) == number => return Ok(Some(monotonic() - asked)),
            Ok(_) => {}
            Err(error) if matches!(error.kind(), ErrorKind::TimedOut | ErrorKind::WouldBlock) => {
                if monotonic() - asked > PATIENCE {
                    return Ok(None);
                }
                std::hint::spin_loop();
            }
            Err(error) => return Err(error.into()),
        }
    }
}

/// In a process of its own: sends back what comes, until it is killed.
pub fn echoes(path: &str, way: Way, core: usize) -> Result<()> {
    let socket = set_up(path, way, core)?;
    socket.set_timeout(None);
    socket.bind(SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, PORT))?;
    println!("hears at {}", ip(1));
    let mut room = [0; MESSAGE];
    loop {
        let flags = if way == Way::Spin { Flags::DONTWAIT } else { Flags::NONE };
        match socket.receive_with(&mut room, flags) {
            Ok(received) => {
                let Sender::Udp(from) = received.from else { continue };
                socket.send_to(&room[..received.len], from)?;
            }
            Err(error) if error.kind() == ErrorKind::WouldBlock => std::hint::spin_loop(),
            Err(error) => return Err(error.into()),
        }
    }
}

fn set_up(path: &str, way: Way, core: usize) -> Result<UdpSocket> {
    let realtime = RealTime { priority: way.priority(PROGRAM_PRIORITY), cpu: Some(core) };
    realtime.apply().into_iter().for_each(|refused| eprintln!("{refused}"));
    let socket = Station::at(path).udp()?;
    socket.set_timeout(Some(Duration::from_nanos(PATIENCE)));
    Ok(socket)
}
