//! The driver's process, and the two threads that read and write it.

use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::process::CommandExt;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use rustix::process::{Pid, Signal, WaitId, WaitIdOptions, kill_process_group, waitid};
use telemime_endpoint::Mono;
use telemime_sim::arm::{ArmModel, Joints};

use super::line::{self, Hello, LineError, Said};
use super::{DriverArm, DriverConfig, Heard, REMEMBERED, Sent};
use crate::servo::thread::{now, wait_until};
use crate::servo::{ArmFault, ArmState};

/// A driver gets this long to say hello and where its joints are.
const GREETING: Duration = Duration::from_secs(10);

/// And this long, ns, to end once it is told to, before it is killed.
const FAREWELL_NS: i64 = 2_000_000_000;

/// How often it is looked at meanwhile, ns.
const LOOK_NS: i64 = 5_000_000;

/// Between its first state and its first setpoint a joint may move by this much, rad or m: by so much the setpoint leaps.
const DRIFT: f64 = 0.01;

/// A joint that is faster when it is to be given its first setpoint, rad/s or m/s, is moved by somebody.
const DRIFTING: f64 = 0.05;

/// Longest line, bytes.
const MAX_LINE: u64 = 1 << 16;

/// States on their way to the servo.
const STATES: usize = 4096;

/// Setpoints on their way to the driver: as many as are made in the longest patience. None is then lost before the driver has failed, and what it
/// reads next is always the newest.
const SETPOINTS: usize = REMEMBERED;

/// Why there is no driver.
#[derive(Debug, thiserror::Error)]
pub enum DriverError {
    /// The command does not run.
    #[error("--driver `{command}`: {source}")]
    Start {
        /// The command.
        command: String,
        /// The system's reason.
        source: std::io::Error,
    },
    /// It ended before it had said what it must.
    #[error(
        "--driver `{command}`: it ended before it had told its joints' state; docs/driver.md says what it must"
    )]
    Ended {
        /// The command.
        command: String,
    },
    /// It says nothing.
    #[error("--driver `{command}`: not a word of hello and the joints' state within {} s; flush every line (docs/driver.md)", GREETING.as_secs())]
    Silent {
        /// The command.
        command: String,
    },
    /// It says something else.
    #[error("--driver `{command}`: line {line}: {source} (docs/driver.md)")]
    Line {
        /// The command.
        command: String,
        /// Which line, from 1.
        line: u64,
        /// What is wrong with it.
        source: LineError,
    },
    /// It reports a fault at once.
    #[error("--driver `{command}` reports a fault: {text}")]
    Fault {
        /// The command.
        command: String,
        /// Its words.
        text: String,
    },
    /// It has fallen silent before it was given a setpoint.
    #[error("--driver `{command}`: it has told its joints' state, and then not any more for {} s: it must tell it all the time (docs/driver.md)", GREETING.as_secs())]
    Mute {
        /// The command.
        command: String,
    },
    /// Its arm is not where it was.
    #[error(
        "--driver `{command}`: joint {joint} has moved by {by:.4} since the driver began, at {speed:.3} a second now: hold the arm still, and start the robot again"
    )]
    Moved {
        /// The command.
        command: String,
        /// The joint, counted from 0.
        joint: usize,
        /// By how much, rad or m.
        by: f64,
        /// How fast it says that it is, rad/s or m/s.
        speed: f64,
    },
    /// It has other joints.
    #[error(
        "--driver `{command}` has the joints {given}, and the arm {wanted}: give the --urdf and --tip of the driver's arm"
    )]
    Joints {
        /// The command.
        command: String,
        /// The driver's.
        given: String,
        /// The arm's.
        wanted: String,
    },
}

enum Greeting {
    Hello(Hello),
    State(ArmState),
    Line(u64, LineError),
    Fault(String),
}

/// A driver that has greeted, and where its arm is. Dropping it ends the process: its input is closed first, and it is killed if it stays.
#[derive(Debug)]
pub struct Bridge {
    /// The command.
    pub command: String,
    /// What it said of itself.
    pub hello: Hello,
    /// Where its arm was when it began.
    pub state: ArmState,
    child: Child,
    stdin: Option<ChildStdin>,
    armed: Arc<AtomicBool>,
    latest: Latest,
    heard: Option<rtrb::Consumer<Heard>>,
    words: Words,
    writer: Option<JoinHandle<()>>,
}

/// Where the arm was when it was last heard of, and when that was.
type Latest = Arc<Mutex<Option<(Mono, ArmState)>>>;

/// What a fault was in the driver's own words.
#[derive(Debug, Clone, Default)]
pub struct Words(Arc<Mutex<Option<String>>>);

impl Words {
    /// The words, if there are any.
    pub fn get(&self) -> Option<String> {
        self.0
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .clone()
    }

    fn set(&self, words: String) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = Some(words);
    }
}

impl Bridge {
    /// Starts `command` by the shell and waits until it has said hello and where its joints are.
    ///
    /// # Errors
    /// [`DriverError`].
    pub fn start(command: &str) -> Result<Self, DriverError> {
        let no_start = |source| DriverError::Start {
            command: command.to_owned(),
            source,
        };
        // A group of its own: Ctrl-C at our terminal must not end it before the arm is at rest.
        let mut child = Command::new("sh")
            .args(["-c", command])
            .process_group(0)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(no_start)?;
        let (stdin, stdout) = (child.stdin.take(), child.stdout.take());
        let stdout = stdout.expect("it was asked to be piped");
        let (states, heard) = rtrb::RingBuffer::new(STATES);
        let (greet, greetings) = sync_channel(2);
        let latest = Latest::default();
        let (armed, words) = (Arc::new(AtomicBool::new(false)), Words::default());
        let mut reader = Reader {
            stdout: BufReader::new(stdout),
            line: Vec::new(),
            lines: 0,
            armed: armed.clone(),
            latest: latest.clone(),
            states,
            words: words.clone(),
        };
        std::thread::Builder::new()
            .name("driver-in".into())
            .spawn(move || reader.run(&greet))
            .map_err(no_start)?;
        let mut bridge = Self {
            command: command.to_owned(),
            hello: Hello {
                telemime_driver: line::VERSION,
                joints: Vec::new(),
                rate_hz: 0.0,
            },
            state: ArmState::default(),
            child,
            stdin,
            armed,
            latest,
            heard: Some(heard),
            words,
            writer: None,
        };
        // What is dropped on the way out ends the process.
        for _ in 0..2 {
            match bridge.greeting(&greetings)? {
                Greeting::Hello(hello) => bridge.hello = hello,
                Greeting::State(state) => bridge.state = state,
                Greeting::Line(line, source) => {
                    return Err(DriverError::Line {
                        command: command.to_owned(),
                        line,
                        source,
                    });
                }
                Greeting::Fault(text) => {
                    return Err(DriverError::Fault {
                        command: command.to_owned(),
                        text,
                    });
                }
            }
        }
        Ok(bridge)
    }

    fn greeting(&self, greetings: &Receiver<Greeting>) -> Result<Greeting, DriverError> {
        greetings.recv_timeout(GREETING).map_err(|e| {
            let command = self.command.clone();
            match e {
                RecvTimeoutError::Timeout => DriverError::Silent { command },
                RecvTimeoutError::Disconnected => DriverError::Ended { command },
            }
        })
    }

    /// The posture its arm is in, rad or m.
    pub fn posture(&self) -> Vec<f64> {
        let q: &Joints = &self.state.q;
        q.iter().take(self.hello.joints.len()).copied().collect()
    }

    /// Whether `arm` has the driver's joints, in its order.
    ///
    /// # Errors
    /// [`DriverError::Joints`].
    pub fn fits(&self, arm: &ArmModel) -> Result<(), DriverError> {
        let wanted: Vec<_> = arm
            .joints()
            .iter()
            .map(|joint| joint.name.clone())
            .collect();
        if wanted == self.hello.joints {
            return Ok(());
        }
        Err(DriverError::Joints {
            command: self.command.clone(),
            given: self.hello.joints.join(", "),
            wanted: wanted.join(", "),
        })
    }

    /// What it said of the last fault.
    pub fn words(&self) -> Words {
        self.words.clone()
    }

    /// The servo's end, for an `arm` that [fits](Self::fits) and is still where it was. To be called once; from then on what the driver says is for the servo.
    ///
    /// # Errors
    /// [`DriverError::Moved`], [`DriverError::Mute`], [`DriverError::Ended`] or [`DriverError::Fault`], and [`DriverError::Start`] if the system gives no thread.
    pub fn arm(
        &mut self,
        arm: Arc<ArmModel>,
        config: DriverConfig,
    ) -> Result<DriverArm, DriverError> {
        self.stays()?;
        let (setpoints, sent) = rtrb::RingBuffer::new(SETPOINTS);
        let (rate_hz, dof) = (config.rate_hz, arm.dof());
        if let Some(stdin) = self.stdin.take() {
            let writer = std::thread::Builder::new()
                .name("driver-out".into())
                .spawn(move || write(stdin, sent, rate_hz, dof))
                .map_err(|source| DriverError::Start {
                    command: self.command.clone(),
                    source,
                })?;
            self.writer = Some(writer);
        }
        let heard = self
            .heard
            .take()
            .unwrap_or_else(|| rtrb::RingBuffer::new(1).1);
        self.armed.store(true, Ordering::SeqCst);
        Ok(DriverArm::new(arm, config, self.state, heard, setpoints))
    }
}

impl Bridge {
    /// Waits for news of the arm, and compares it with where it was when the driver began: meanwhile an arm was loaded, and somebody may have moved this one.
    fn stays(&mut self) -> Result<(), DriverError> {
        let asked = now();
        let mut at = asked;
        let command = || self.command.clone();
        let state = loop {
            let latest = *self.latest.lock().unwrap_or_else(PoisonError::into_inner);
            if let Some((_, state)) = latest.filter(|(at, _)| *at > asked) {
                break state;
            }
            // Before the arm is handed over only faults are in this ring.
            if let Some(Heard::Fault(fault)) = self.heard.as_mut().and_then(|ring| ring.pop().ok())
            {
                return Err(match fault {
                    ArmFault::Ended => DriverError::Ended { command: command() },
                    fault => DriverError::Fault {
                        command: command(),
                        text: self.words.get().unwrap_or_else(|| fault.to_string()),
                    },
                });
            }
            if at.secs_since(asked) > GREETING.as_secs_f64() {
                return Err(DriverError::Mute { command: command() });
            }
            at = wait_until(at.0 + LOOK_NS);
        };
        for joint in 0..self.hello.joints.len() {
            let (by, speed) = (state.q[joint] - self.state.q[joint], state.qd[joint]);
            if !(by.abs() <= DRIFT && speed.abs() <= DRIFTING) {
                return Err(DriverError::Moved {
                    command: command(),
                    joint,
                    by,
                    speed,
                });
            }
        }
        Ok(())
    }

    /// Waits, for [`FAREWELL_NS`] at most, until the process has ended and nobody holds the writer up; says whether.
    fn is_over(&self) -> bool {
        let mut at = now();
        let until = at.0 + FAREWELL_NS;
        // Its number stays its own until it is waited for at last.
        let ended = || {
            let look = WaitIdOptions::EXITED | WaitIdOptions::NOHANG | WaitIdOptions::NOWAIT;
            let status = waitid(WaitId::Pid(Pid::from_child(&self.child)), look);
            !matches!(status, Ok(None))
        };
        loop {
            if ended() && self.writer.as_ref().is_none_or(JoinHandle::is_finished) {
                return true;
            }
            if at.0 >= until {
                return false;
            }
            at = wait_until(at.0 + LOOK_NS);
        }
    }
}

impl Drop for Bridge {
    fn drop(&mut self) {
        // The writer has ended with the servo, and closed the driver's input; without one it is closed here.
        drop(self.stdin.take());
        if !self.is_over() {
            // It, and what it has started, which may be what does not read.
            let _ = kill_process_group(Pid::from_child(&self.child), Signal::KILL);
            if !self.is_over() {
                // Nothing that is left can be ended from here; nobody waits for it.
                return;
            }
        }
        let _ = self.child.wait();
        if let Some(writer) = self.writer.take() {
            let _ = writer.join();
        }
    }
}

struct Reader {
    stdout: BufReader<ChildStdout>,
    line: Vec<u8>,
    lines: u64,
    armed: Arc<AtomicBool>,
    latest: Latest,
    states: rtrb::Producer<Heard>,
    words: Words,
}

impl Reader {
    fn run(&mut self, greet: &SyncSender<Greeting>) {
        if !self.next() {
            return;
        }
        let hello = match line::hello(&self.line) {
            Ok(hello) => hello,
            Err(e) => return drop(greet.send(Greeting::Line(self.lines, e))),
        };
        let dof = hello.joints.len();
        // Whoever is to hear it has given up, if it cannot be sent.
        let _ = greet.send(Greeting::Hello(hello));
        let mut greeted = false;
        while self.next() {
            let said = line::said(&self.line, dof);
            let at = now();
            if !greeted {
                greeted = true;
                let greeting = match said {
                    Ok(Said::State(state, _)) => Greeting::State(state),
                    Ok(Said::Fault(text)) => Greeting::Fault(text),
                    Err(e) => Greeting::Line(self.lines, e),
                };
                let _ = greet.send(greeting);
                continue;
            }
            let heard = match said {
                Ok(Said::State(state, obeyed)) => Heard::State { at, state, obeyed },
                Ok(Said::Fault(text)) => {
                    self.words.set(text);
                    Heard::Fault(ArmFault::Reported)
                }
                Err(e) => {
                    self.words.set(e.to_string());
                    Heard::Fault(ArmFault::Garbage { line: self.lines })
                }
            };
            self.tell(heard);
        }
        self.tell(Heard::Fault(ArmFault::Ended));
    }

    /// The next line, or as much of it as a line may have; false at the end.
    fn next(&mut self) -> bool {
        self.line.clear();
        self.lines += 1;
        let read = (&mut self.stdout)
            .take(MAX_LINE)
            .read_until(b'\n', &mut self.line);
        read.is_ok_and(|n| n > 0)
    }

    /// Before the servo is there only the newest state is news, but every fault is; a full ring is a servo that has died.
    fn tell(&mut self, heard: Heard) {
        match heard {
            Heard::State { at, state, .. } if !self.armed.load(Ordering::SeqCst) => {
                let mut latest = self.latest.lock().unwrap_or_else(PoisonError::into_inner);
                *latest = Some((at, state));
            }
            _ => {
                let _ = self.states.push(heard);
            }
        }
    }
}

/// Writes the newest setpoint as often as the driver wants one, until the servo is gone or the driver does not read any more.
fn write(mut stdin: ChildStdin, mut sent: rtrb::Consumer<Sent>, rate_hz: f64, dof: usize) {
    let period_ns = (1e9 / rate_hz) as i64;
    let mut line = Vec::new();
    let mut due = now().0;
    loop {
        let mut newest = None;
        while let Ok(next) = sent.pop() {
            newest = Some(next);
        }
        if let Some(newest) = newest {
            line::setpoint(&newest, dof, &mut line);
            // The end of a process is seen where it is read.
            if stdin.write_all(&line).and_then(|()| stdin.flush()).is_err() {
                return;
            }
        }
        if sent.is_abandoned() {
            return;
        }
        due = (due + period_ns).max(now().0);
        wait_until(due);
    }
}
