//! The driver's process, and the two threads that read and write it.

use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::process::CommandExt;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process_group};
use telemime_sim::arm::{ArmModel, Joints};

use super::line::{self, Hello, LineError, Said};
use super::{DriverArm, DriverConfig, Heard, Sent};
use crate::servo::thread::{now, wait_until};
use crate::servo::{ArmFault, ArmState};

/// A driver gets this long to say hello and where its joints are.
const GREETING: Duration = Duration::from_secs(10);

/// And this long to end once it is told to, before it is killed.
const FAREWELL: Duration = Duration::from_secs(2);

/// Longest line, bytes.
const MAX_LINE: u64 = 1 << 16;

/// States on their way to the servo.
const STATES: usize = 4096;

/// Setpoints on their way to the driver: more than wait while it is not behind.
const SETPOINTS: usize = 256;

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
    heard: Option<rtrb::Consumer<Heard>>,
    words: Words,
    ended: Receiver<()>,
    writer: Option<JoinHandle<()>>,
}

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
        let (at_end, ended) = sync_channel::<()>(1);
        let (armed, words) = (Arc::new(AtomicBool::new(false)), Words::default());
        let mut reader = Reader {
            stdout: BufReader::new(stdout),
            line: Vec::new(),
            lines: 0,
            armed: armed.clone(),
            states,
            words: words.clone(),
        };
        std::thread::Builder::new()
            .name("driver-in".into())
            .spawn(move || {
                reader.run(&greet);
                drop(at_end);
            })
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
            heard: Some(heard),
            words,
            ended,
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

    /// The servo's end, for an `arm` that [fits](Self::fits). To be called once; from then on what the driver says is for the servo.
    ///
    /// # Errors
    /// [`DriverError::Start`] if the system gives no thread.
    pub fn arm(&mut self, arm: Arc<ArmModel>, patience_s: f64) -> Result<DriverArm, DriverError> {
        let (setpoints, sent) = rtrb::RingBuffer::new(SETPOINTS);
        let (rate_hz, dof) = (self.hello.rate_hz, arm.dof());
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
        let config = DriverConfig {
            rate_hz,
            patience_s,
        };
        Ok(DriverArm::new(arm, config, self.state, heard, setpoints))
    }
}

impl Drop for Bridge {
    fn drop(&mut self) {
        // The writer has ended with the servo, and closed the driver's input; without one it is closed here.
        drop(self.stdin.take());
        if matches!(
            self.ended.recv_timeout(FAREWELL),
            Err(RecvTimeoutError::Timeout)
        ) {
            // It, and what it has started; all of that may be gone already.
            let _ = kill_process_group(Pid::from_child(&self.child), Signal::KILL);
        }
        let _ = self.child.wait();
        if let Some(writer) = self.writer.take() {
            // With the process gone nothing holds it up.
            let _ = writer.join();
        }
    }
}

struct Reader {
    stdout: BufReader<ChildStdout>,
    line: Vec<u8>,
    lines: u64,
    armed: Arc<AtomicBool>,
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

    /// Before the servo is there a state is not news for long, but a fault is; a full ring is a servo that has died.
    fn tell(&mut self, heard: Heard) {
        if self.armed.load(Ordering::SeqCst) || matches!(heard, Heard::Fault(_)) {
            let _ = self.states.push(heard);
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
