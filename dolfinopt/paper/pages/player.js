(function () {
  const get = (id) => document.getElementById(id);
  const film = JSON.parse(get("frames").textContent);
  const slider = get("frame"), button = get("play");
  let timer = null;
  function show(i) {
    get("before").setAttribute("d", film.before[i]);
    get("after").setAttribute("d", film.after[i]);
    get("cart").setAttribute("transform", "translate(" + film.cart[i] + ",0)");
    ["before", "after"].forEach(function (name, k) {
      get("tip-" + name).setAttribute("cx", film.tips[i][2 * k]);
      get("tip-" + name).setAttribute("cy", film.tips[i][2 * k + 1]);
    });
    get("said").textContent = film.t[i].toFixed(2) + " s: " + film.mm[i][0].toFixed(1) + " mm, "
      + film.mm[i][1].toFixed(1) + " mm";
    slider.value = i;
  }
  function stop() { clearInterval(timer); timer = null; button.textContent = "Play"; }
  function play() {
    button.textContent = "Pause";
    timer = setInterval(function () {
      show((Number(slider.value) + 1) % film.t.length);
    }, film.delay);
  }
  button.addEventListener("click", function () { if (timer) { stop(); } else { play(); } });
  slider.addEventListener("input", function () { stop(); show(Number(slider.value)); });
})();
