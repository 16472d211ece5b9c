//! What befalls a shift.

use tokio::time::Instant;

use super::*;

impl Shift {
    fn some_driver(&mut self) -> Option<usize> {
        let count = self.drivers.len();
        (count > 0).then(|| self.rng.random_range(0..count))
    }

    async fn outage(&mut self, span_s: f64) {
        self.note(format!("the link is dead for {span_s:.3} s"));
        self.pair.network.set_down(true);
        self.pass(span_s).await;
        self.pair.network.set_down(false);
        self.note("the link is back");
        self.disturbed_at = self.pair.now();
    }

    /// Two round trips and a redial after the link is back there is news again.
    async fn promise(&mut self) {
        let settled_s = self.pair.now().secs_since(self.disturbed_at);
        let [driver] = &self.drivers[..] else { return };
        let fresh = self.pair.now().secs_since(driver.heard_at) < 0.2;
        if !fresh || settled_s < 3.0 || !driver.links.iter().all(is_clean) {
            return;
        }
        let name = driver.name.clone();
        let slowest_s = |l: &LinkConfig| l.delay_s + l.jitter_s;
        let rtt_s: f64 = driver.links.iter().map(slowest_s).sum();
        let span_s = spread(&mut self.rng, 0.2, 20.0);
        self.outage(span_s).await;
        let (back, began, former) = (self.pair.now(), Instant::now(), self.epoch);
        self.pair.network.log();
        let most_s = 2.0 * rtt_s + NEWS_S;
        let Some(before) = self.drivers.first().map(|d| d.telemetry) else {
            return;
        };
        loop {
            self.pair.run_for(5e-3).await;
            self.look().await;
            // A task that has ended meanwhile has nothing to come back for.
            let Some(driver) = self.drivers.first().filter(|d| d.name == name) else {
                return;
            };
            let took_s = self.pair.now().secs_since(back) - 5e-3;
            // Whose task was over has come to say goodbye.
            let left = self.ended > former && driver.epoch == Some(self.ended);
            if driver.telemetry > before || left {
                self.tally.promises += 1;
                self.tally.slowest_share = self.tally.slowest_share.max(took_s / most_s);
                self.pair.network.logged();
                return;
            }
            self.must(took_s <= most_s, || {
                let since_s = |at: Instant| at.duration_since(began).as_secs_f64();
                let mut story = format!(
                    "{name}: no news {took_s:.3} s after an outage of {span_s:.3} s, RTT {rtt_s:.3} s; since then:"
                );
                for p in self.pair.network.logged() {
                    let way = if p.to == self.pair.robot_addr() { "up" } else { "down" };
                    let arrives_s = p.arrives.map_or(f64::NAN, since_s);
                    let sent_s = since_s(p.sent);
                    story += &format!("\n    {sent_s:.4} → {arrives_s:.4} {way}, {} bytes", p.len_bytes);
                }
                story
            });
        }
    }

    async fn stop_there(&mut self, i: usize) {
        let driver = &self.drivers[i];
        driver.operator.say(Word::Stop);
        self.note(format!("{} says stop", self.drivers[i].name));
        let span_s = spread(&mut self.rng, 0.01, 3.0);
        self.pass(span_s).await;
        if let Some(driver) = self.drivers.get(i) {
            driver.operator.say(Word::Reset);
            self.note(format!("{} says reset", self.drivers[i].name));
        }
    }

    pub(super) fn reset_here(&mut self) {
        self.note("the robot is reset by hand");
        self.model.borrow_mut().reset_here();
        self.pair.robot.say(Word::Reset);
    }

    /// Whatever the operator's clock is set to, what was followed is followed no longer, a second later.
    async fn clock_step(&mut self) {
        let Some(clocks) = self.clocks.clone() else {
            return;
        };
        let span_ns = (spread(&mut self.rng, 2e-3, 2.0) * 1e9) as i64;
        let sign = if self.rng.random_bool(0.5) { 1 } else { -1 };
        self.note(format!(
            "a clock is set by {} s",
            (sign * span_ns) as f64 * 1e-9
        ));
        clocks.fetch_add(sign * span_ns, Ordering::Relaxed);
        self.clocks_are_right = false;
        let settled_s = self.pair.now().secs_since(self.disturbed_at);
        let clean = |d: &Driver| d.links.iter().all(is_clean);
        let watched = settled_s > 3.0 && self.drivers.len() == 1 && self.drivers.iter().all(clean);
        self.disturbed_at = self.pair.now();
        let newest = |shift: &Self| shift.model.borrow().newest().copied();
        let following = follows;
        let before = newest(self).filter(|r| {
            watched
                && following(r.state)
                && r.at.secs_since(r.engaged_at) > 2.0
                && r.plan_s.is_none()
        });
        self.pass(2.0).await;
        if let (Some(before), Some(after)) = (before, newest(self)) {
            let goes_on = following(after.state) && after.engagement == before.engagement;
            self.must(!goes_on, || {
                "a clock that was set did not stop the arm".into()
            });
        }
    }

    fn garbage(&mut self) {
        let robot = self.pair.robot_addr();
        let victim = self.some_driver().map(|i| self.drivers[i].operator.addr);
        let nowhere = SocketAddr::from(([10, 9, 9, 9], 9));
        for _ in 0..self.rng.random_range(1..200) {
            let len = self.rng.random_range(1..1400);
            let mut packet: Vec<u8> = (0..len).map(|_| self.rng.random()).collect();
            if self.rng.random_bool(0.4) && len > 5 {
                packet[..5].copy_from_slice(&[0xc3, 0, 0, 0, 1]);
            }
            let (from, to) = match (self.rng.random_range(0..3), victim) {
                (0, Some(victim)) => (victim, robot),
                (1, Some(victim)) => (robot, victim),
                _ => (nowhere, robot),
            };
            self.pair.network.forge(from, to, packet);
        }
    }

    /// Greets as the paired operator would, and then says anything at all.
    async fn rogue(&mut self) {
        let link = LinkConfig {
            delay_s: 0.01,
            ..LinkConfig::default()
        };
        let (robot, seed) = (self.pair.robot_addr(), self.rng.random());
        let endpoint = self.pair.stranger(&link, seed).unwrap();
        self.started += 1;
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
        let talk = async move {
            let connection = endpoint.connect(robot, "telemime").ok()?.await.ok()?;
            let mut control = Control::open(&connection).await.ok()?;
            let hello = Hello {
                min: VERSION,
                max: VERSION,
                features: 0,
            };
            control.write(&hello.encode()).await.ok()?;
            let Answer::Ack { .. } = control.answer().await.ok()? else {
                return None;
            };
            for _ in 0..100 {
                let mut datagram: Vec<u8> = (0..rng.random_range(1..200))
                    .map(|_| rng.random())
                    .collect();
                datagram[0] %= 6;
                connection.send_datagram(datagram.into()).ok()?;
                tokio::time::sleep_until(tokio::time::Instant::now() + Duration::from_millis(5))
                    .await;
            }
            let nonsense: Vec<u8> = (0..300).map(|_| rng.random()).collect();
            control.write(&nonsense).await.ok()?;
            connection.closed().await;
            Some(())
        };
        let talk = tokio::time::timeout(Duration::from_secs(5), talk);
        tokio::task::spawn_local(talk);
        self.disturbed_at = self.pair.now();
        self.pass(1.0).await;
        self.disturbed_at = self.pair.now();
    }

    pub(super) async fn befall(&mut self, mischief: Mischief) {
        *self
            .tally
            .mischief
            .entry(format!("{mischief:?}"))
            .or_default() += 1;
        self.note(format!("{mischief:?}"));
        let Some(i) = self.some_driver() else { return };
        match mischief {
            Mischief::Peace => {}
            Mischief::Links => {
                self.drivers[i].links = [link(&mut self.rng), link(&mut self.rng)];
                let seed = self.rng.random();
                let [up, down] = &self.drivers[i].links;
                self.note(format!("up {up}, down {down}"));
                self.wire(i, seed);
            }
            Mischief::Outage => {
                let span_s = spread(&mut self.rng, 0.05, 8.0);
                self.outage(span_s).await;
            }
            Mischief::Promise => self.promise().await,
            Mischief::StopHere => {
                self.model.borrow_mut().stop_here(self.pair.now());
                self.pair.robot.say(Word::Stop);
                let span_s = spread(&mut self.rng, 0.01, 5.0);
                self.pass(span_s).await;
                self.reset_here();
            }
            Mischief::StopThere => self.stop_there(i).await,
            Mischief::Quit => self.drivers[i].operator.quit(),
            Mischief::KillOperator => self.drivers[i].operator.kill(&self.pair.network),
            Mischief::RestartRobot => {
                self.hear_robot();
                self.pair.restart_robot(&self.rig).unwrap();
                self.model.borrow_mut().restart();
                (self.epoch, self.path) = (0, None);
                self.paths.clear();
                self.drivers.iter_mut().for_each(|d| d.engaged.clear());
                self.disturbed_at = self.pair.now();
            }
            Mischief::Rebind => {
                let to = SocketAddr::from((
                    [198, 51, 100, self.rng.random()],
                    self.rng.random_range(1024..9999),
                ));
                let seed = self.rng.random();
                self.drivers[i]
                    .operator
                    .rebind(&self.pair.network, to)
                    .unwrap();
                self.wire(i, seed);
            }
            Mischief::ClockStep => self.clock_step().await,
            Mischief::Second if self.drivers.len() < 3 => self.join(true),
            Mischief::Stranger if self.drivers.len() < 3 => self.join(false),
            Mischief::Second | Mischief::Stranger => {}
            Mischief::Rogue => self.rogue().await,
            Mischief::Garbage => self.garbage(),
            Mischief::Replay => {
                self.pair.network.record();
                self.pass(0.5).await;
                let again = self.pair.network.replay();
                self.note(format!("{again} packets once more"));
            }
        }
    }
}
